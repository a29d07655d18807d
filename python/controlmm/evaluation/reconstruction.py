"""Metrics of a motion tokenizer: joint error of what it reconstructs, and how much of its codes it uses.

Source: Guo et al., MoMask, CVPR 2024 (MPJPE as in its evaluation of the tokenizer).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.models.rvq_vae import frame_mask


def root_aligned_error(
    joints: Float[Tensor, "B T J 3"], targets: Float[Tensor, "B T J 3"], *, lengths: Int[Tensor, "B"]
) -> Float[Tensor, "B"]:
    """MPJPE of each clip: mean distance of joints to targets, both with the root moved to the origin.

    Mean over the frames of the clip and all joints (the root's zero counts, as published), in the unit of
    ``joints``. Only the position of the root is taken away, not its heading.
    """
    relative = [x - x[:, :, :1] for x in (joints, targets)]
    return _frame_mean((relative[0] - relative[1]).norm(dim=-1).mean(-1), lengths)


def global_error(
    joints: Float[Tensor, "B T J 3"], targets: Float[Tensor, "B T J 3"], *, lengths: Int[Tensor, "B"]
) -> Float[Tensor, "B"]:
    """Mean distance of joints to targets where they stand, in the unit of ``joints``: shows drift too."""
    return _frame_mean((joints - targets).norm(dim=-1).mean(-1), lengths)


def code_perplexity(ids: Int[Tensor, "*N Q"], *, codebook_size: int) -> Float[Tensor, "Q"]:
    """``exp`` of the entropy of each layer's code histogram: 1 if one code is always taken, K if all alike.

    Histograms of all tokens given, so give all of a data set: the mean over batches would be lower.

    Args:
        ids: Codes; -1 (padding, or a layer left out) does not count.
        codebook_size: ``K``.
    """
    flat = ids.reshape(-1, ids.shape[-1])
    layers = []
    for layer in range(flat.shape[1]):
        used = flat[:, layer][flat[:, layer] >= 0]
        share = torch.bincount(used, minlength=codebook_size).double() / max(1, len(used))
        layers.append(torch.special.entr(share).sum().exp())
    return torch.stack(layers)


def code_usage(ids: Int[Tensor, "*N Q"], *, codebook_size: int) -> Float[Tensor, "Q"]:
    """Share of each layer's codes that occur at all; -1 does not count."""
    flat = ids.reshape(-1, ids.shape[-1])
    used = [len(layer[layer >= 0].unique()) for layer in flat.T]
    return torch.tensor(used, dtype=torch.float64) / codebook_size


@dataclass(frozen=True, eq=False)
class CodeStatistics:
    """How a tokenizer uses its codes on a data set.

    Attributes:
        codebook_size: Codes of a layer, ``K``.
        perplexity: (Q,), see :func:`code_perplexity`.
        usage: (Q,), see :func:`code_usage`.
    """

    codebook_size: int
    perplexity: Float[Tensor, "Q"]
    usage: Float[Tensor, "Q"]


@torch.no_grad()
def code_statistics(decoder: MotionDecoder, clips: Sequence[Float[Tensor, "T D"]]) -> CodeStatistics:
    """Codes of all ``clips`` (de-normalised features, each cut to whole tokens) taken together.

    For a tokenizer of body parts, layers are parts.
    """
    tokenizer, step = decoder.tokenizer, decoder.downsample
    ids = []
    for clip in clips:
        frames = len(clip) // step * step
        encoded = tokenizer.encode(decoder.normalizer.normalize(clip[None, :frames]))
        ids.append(encoded[0])
    size, every = tokenizer.config.codebook_size, torch.cat(ids)
    return CodeStatistics(
        size, code_perplexity(every, codebook_size=size), code_usage(every, codebook_size=size)
    )


def _frame_mean(error: Float[Tensor, "B T"], lengths: Int[Tensor, "B"]) -> Float[Tensor, "B"]:
    inside = frame_mask(lengths, error.shape[1])
    return (error * inside).sum(1) / lengths.clamp(min=1)
