"""Drawing the codes of every body part from the trajectory transformer's logits."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from controlmm.generation.noise import ClipNoise

_STREAMS = 64  # more than parts; keeps the streams of neighbouring seeds apart


def draw_part_codes(
    logits: Float[Tensor, "B L P K"], seeds: Sequence[int], *, temperature: float
) -> Int[Tensor, "B L P"]:
    """Code ids, one draw from ``softmax(logits / temperature)`` for every token of every part.

    A part's noise is the same in all its tokens: each token alone is a fair draw, and neighbours with like
    logits get like codes, so that motions do not tremble.

    Args:
        logits: Of the trajectory transformer.
        seeds: One a clip; every part has a stream of its own, whatever the batch or padding.
        temperature: 0 takes the most likely codes, as the paper does.
    """
    if temperature == 0:
        return logits.argmax(-1)
    batch, _, parts, codes = logits.shape
    drawn = []
    for part in range(parts):
        noise = ClipNoise([(seed * _STREAMS + part) % 2**63 for seed in seeds])
        gumbel = noise.gumbel([1] * batch, padded=1, width=codes)
        drawn.append((logits[:, :, part] + temperature * gumbel).argmax(-1))
    return torch.stack(drawn, dim=-1)
