"""Checks of a pipeline's arguments: everything is refused before any network runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.controls import Objective
from controlmm.models.control_branch import ControlBranchConfig
from controlmm.models.length_estimator import LengthEstimatorConfig
from controlmm.models.masked_transformer import MaskedTransformerConfig
from controlmm.models.part_vq_vae import PartVqVaeConfig
from controlmm.models.residual_control import ResidualControlConfig
from controlmm.models.residual_transformer import ResidualTransformerConfig
from controlmm.models.rvq_vae import RvqVaeConfig
from controlmm.models.trajectory_transformer import TrajectoryTransformerConfig
from controlmm.motion.body_parts import trajectory_joints
from controlmm.motion.skeleton import Skeleton

MIN_FRAMES = 8
_DEFAULT_SECONDS = 6.0
_LARGEST_SEED = 2**63 - 1  # of torch's generators


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
    """Raise ``ValueError`` unless ``samples`` is a whole number from 1, ``seed`` one from 0 below 2^63."""
    for name, value, least in (("samples", samples, 1), ("seed", seed, 0)):
        if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
            raise ValueError(f"`{name}` must be a whole number of at least {least}, got {value!r}.")
    if seed > _LARGEST_SEED:
        raise ValueError(f"`seed` must be at most {_LARGEST_SEED} (2^63 - 1), got {seed}.")


def check_objectives(
    objectives: Sequence[Objective], frames: int, skeleton: Skeleton, origin: Float[Tensor, "3"]
) -> tuple[tuple[Objective, bool], ...]:
    """The objectives, each with whether it takes many clips at once; tried on two standing poses.

    Raises:
        TypeError: If an entry is no objective, or one returns no tensor.
        ValueError: If an objective cannot be minimised, see :meth:`Objective.check`.
    """
    if not isinstance(objectives, Sequence):
        raise TypeError(f"`objectives` must be a list of Objective, got {type(objectives).__name__}.")
    for index, objective in enumerate(objectives):
        if not isinstance(objective, Objective):
            raise TypeError(
                f"`objectives[{index}]` must be an Objective, got {type(objective).__name__}. "
                "Wrap a function: Objective(fn)."
            )
    if not objectives:
        return ()
    trial = standing_poses(frames, skeleton) + origin
    return tuple((objective, objective.check(trial)) for objective in objectives)


def standing_poses(frames: int, skeleton: Skeleton) -> Float[Tensor, "2 T J 3"]:
    """Two clips of a made-up body that shifts a little, no two joints or frames alike."""
    generator = torch.Generator().manual_seed(0)
    heights = torch.linspace(0.1, 1.6, skeleton.num_joints)[:, None] * torch.tensor([0.0, 1.0, 0.0])
    sway = 0.1 * torch.rand(2, frames, skeleton.num_joints, 3, generator=generator)
    return (heights + sway) * (1000.0 if skeleton.unit == "mm" else 1.0)


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
    residual_control: ResidualControlConfig | None = None,
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
        (
            "downsample",
            "residual_control",
            tokenizer.downsample,
            tokenizer.downsample if residual_control is None else residual_control.downsample,
        ),
        ("text_dim", "transformer", text_dim, transformer.text_dim),
        ("text_dim", "residual", text_dim, residual.text_dim),
        ("text_dim", "length", text_dim, text_dim if length is None else length.text_dim),
    ):
        if wanted != found:
            raise ValueError(f"The parts do not fit: `{name}` of `{part}` must be {wanted}, got {found}.")
    for name, joints in (
        ("control", control.joints),
        ("residual_control", () if residual_control is None else residual_control.joints),
    ):
        if max(joints, default=0) >= skeleton.num_joints:
            raise ValueError(
                f"`joints` of `{name}` must be below {skeleton.num_joints} for the {skeleton.name} skeleton, "
                f"got {max(joints)}."
            )


def check_tlcontrol_sizes(
    *,
    tokenizer: PartVqVaeConfig,
    transformer: TrajectoryTransformerConfig,
    skeleton: Skeleton,
    text_dim: int,
    length: LengthEstimatorConfig | None = None,
) -> None:
    """Raise ``ValueError`` unless TLControl's networks, statistics and text encoder fit each other."""
    is_published = tokenizer.latent_norm == "clip"
    for name, part, wanted, found in (
        ("feature_dim", "tokenizer", skeleton.feature_dim, tokenizer.feature_dim),
        ("codebook_size", "transformer", tokenizer.codebook_size, transformer.codebook_size),
        ("num_parts", "transformer", tokenizer.num_parts, transformer.num_parts),
        ("downsample", "transformer", tokenizer.downsample, transformer.downsample),
        ("joints", "transformer", trajectory_joints(skeleton), transformer.joints),
        ("form", "transformer", "published" if is_published else "masked", transformer.form),
        ("text_dim", "transformer", text_dim, transformer.text_dim),
        ("text_dim", "length", text_dim, text_dim if length is None else length.text_dim),
    ):
        if wanted != found:
            raise ValueError(f"The parts do not fit: `{name}` of `{part}` must be {wanted}, got {found}.")
