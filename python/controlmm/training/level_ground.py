"""Leaves out training clips whose ground rises: stairs, climbing, hanging, drifting recordings.

No feature tells a network where the ground is, so from such clips it learns to rise for no reason.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.data.clip import FeatureClip
from controlmm.motion.skeleton import skeleton_of_width
from controlmm.ops import recover_joints

_WINDOW = 2.0  # seconds; within it a body that jumps or is thrown touches the ground again


@dataclass(frozen=True)
class ClipSelection:
    """Which recorded clips are trained on."""

    max_floor_range: float = math.inf  # metres that the lowest point of the body may rise or sink for long

    def __post_init__(self) -> None:
        if not self.max_floor_range > 0:
            raise ValueError(f"`max_floor_range` must be a positive height, got {self.max_floor_range}.")


def select(clips: Sequence[FeatureClip], selection: ClipSelection) -> list[FeatureClip]:
    """The clips of ``clips`` that ``selection`` takes, in their order."""
    if math.isinf(selection.max_floor_range):
        return list(clips)
    return [clip for clip in clips if floor_range(clip) <= selection.max_floor_range]


def floor_range(clip: FeatureClip) -> float:
    """By how many metres the floor of a clip rises and sinks.

    The floor at a frame is the lowest height that any joint has within a second before or after it.
    """
    skeleton = skeleton_of_width(clip.features.shape[1])
    heights = recover_joints(clip.features[None], joints=skeleton.num_joints)[0, ..., 1].amin(-1)
    floor = _lowest_nearby(heights, round(_WINDOW * skeleton.fps / 2))
    return float(floor.max() - floor.min()) * skeleton.metres


def _lowest_nearby(heights: Float[Tensor, "T"], reach: int) -> Float[Tensor, "T"]:
    padded = torch.nn.functional.pad(-heights, (reach, reach), value=-math.inf)
    return -padded.unfold(0, 2 * reach + 1, 1).amax(-1)
