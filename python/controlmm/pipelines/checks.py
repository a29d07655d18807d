"""Checks of a pipeline's arguments: everything is refused before any network runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real

from jaxtyping import Bool
from torch import Tensor

from controlmm.models.control_branch import ControlBranchConfig
from controlmm.models.length_estimator import LengthEstimatorConfig
from controlmm.models.masked_transformer import MaskedTransformerConfig
from controlmm.models.residual_transformer import ResidualTransformerConfig
from controlmm.models.rvq_vae import RvqVaeConfig
from controlmm.motion.skeleton import Skeleton

MIN_FRAMES = 8
_DEFAULT_SECONDS = 6.0


def frame_count(*, seconds: float | None, frames: int | None, skeleton: Skeleton, max_frames: int) -> int:
    """Length of the motion in frames; 6 s when neither is given.

    Raises:
        ValueError: If both are given, or the length is not a number from 8 frames to ``max_frames``.
    """
    if seconds is not None and frames is not None:
        raise ValueError(f"Pass `seconds` or `frames`, not both (got {seconds} and {frames}).")
    if frames is None:
        seconds = _DEFAULT_SECONDS if seconds is None else seconds
        if isinstance(seconds, bool) or not isinstance(seconds, Real) or math.isnan(seconds):
            raise ValueError(f"`seconds` must be a number, got {seconds!r}.")
        if not MIN_FRAMES <= round(min(seconds, 1e6) * skeleton.fps) <= max_frames:
            raise ValueError(
                f"`seconds` must be between {MIN_FRAMES / skeleton.fps:g} and {max_frames / skeleton.fps:g}, "
                f"got {seconds}."
            )
        return round(seconds * skeleton.fps)
    if isinstance(frames, bool) or not isinstance(frames, Integral):
        raise ValueError(f"`frames` must be a whole number, got {frames!r}.")
    if not MIN_FRAMES <= frames <= max_frames:
        raise ValueError(f"`frames` must be between {MIN_FRAMES} and {max_frames}, got {frames}.")
    return int(frames)


def check_sampling(*, samples: int, seed: int) -> None:
    """Raise ``ValueError`` unless ``samples`` is a positive and ``seed`` a non-negative whole number."""
    for name, value, least in (("samples", samples, 1), ("seed", seed, 0)):
        if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
            raise ValueError(f"`{name}` must be a whole number of at least {least}, got {value!r}.")


def check_masks_end(mask: Bool[Tensor, "B T J 3"], lengths: Sequence[int]) -> None:
    """Raise ``ValueError`` when a target lies after the end of its clip, where no motion can meet it."""
    for clip, (clip_mask, length) in enumerate(zip(mask, lengths, strict=True)):
        beyond = clip_mask[length:].flatten(1).any(1).nonzero()
        if len(beyond):
            raise ValueError(
                f"`mask` controls frame {length + int(beyond[0])} of clip {clip}, which has {length} frames."
            )


def check_sizes(
    *,
    tokenizer: RvqVaeConfig,
    transformer: MaskedTransformerConfig,
    residual: ResidualTransformerConfig,
    control: ControlBranchConfig,
    skeleton: Skeleton,
    text_dim: int,
    length: LengthEstimatorConfig | None = None,
) -> None:
    """Raise ``ValueError`` unless networks, statistics and text encoder were made for each other."""
    for name, part, wanted, found in (
        ("feature_dim", "tokenizer", skeleton.feature_dim, tokenizer.feature_dim),
        ("codebook_size", "transformer", tokenizer.codebook_size, transformer.codebook_size),
        ("codebook_size", "residual", tokenizer.codebook_size, residual.codebook_size),
        ("num_quantizers", "residual", tokenizer.num_quantizers, residual.num_quantizers),
        ("downsample", "control", tokenizer.downsample, control.downsample),
        ("text_dim", "transformer", text_dim, transformer.text_dim),
        ("text_dim", "residual", text_dim, residual.text_dim),
        ("text_dim", "length", text_dim, text_dim if length is None else length.text_dim),
    ):
        if wanted != found:
            raise ValueError(f"The parts do not fit: `{name}` of `{part}` must be {wanted}, got {found}.")
    if max(control.joints) >= skeleton.num_joints:
        raise ValueError(
            f"`joints` of `control` must be below {skeleton.num_joints} for the {skeleton.name} skeleton, "
            f"got {max(control.joints)}."
        )
