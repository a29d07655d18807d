"""Targets that no body can meet: two joints of one frame farther apart than the bones between them."""

from __future__ import annotations

import warnings

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.controls import DenseControls
from controlmm.motion.skeleton import Skeleton

_SLACK = 0.02  # share of the reach: bodies of the data differ a little from the skeleton's


def check_reach(controls: DenseControls, skeleton: Skeleton, *, is_strict: bool) -> Bool[Tensor, "T"]:
    """Frames whose targets bones can span; a warning if there are others, or refusal.

    Args:
        controls: One clip's targets; distances are measured along the axes that both joints have.
        skeleton: Whose bones; nothing is checked where their lengths are not published.
        is_strict: Refuse.

    Raises:
        ValueError: If ``is_strict`` and a pair of targets is out of reach.
    """
    reached = torch.ones(len(controls.mask), dtype=torch.bool)
    if skeleton.bone_lengths is None:
        return reached
    worst = _worst_pair(controls, chain_lengths(skeleton), reached)
    if worst is None:
        return reached
    frame, first, second, distance, reach = worst
    names = skeleton.joint_names
    text = (
        f"`controls` ask for the impossible: in frame {frame}, {names[second]} is to be {distance:.2f} "
        f"{skeleton.unit} away from {names[first]}, but the bones between them reach {reach:.2f} "
        f"{skeleton.unit}. Move one of them, or leave one free."
    )
    if is_strict:
        raise ValueError(text)
    warnings.warn(text + " The motion will come as near as it can.", stacklevel=4)
    return reached


def chain_lengths(skeleton: Skeleton) -> Float[Tensor, "J J"]:
    """Sum of the bones along the way from joint to joint: the farthest that they can be apart."""
    count = skeleton.num_joints
    lengths = torch.full((count, count), torch.inf, dtype=torch.float64)
    lengths.fill_diagonal_(0)
    bones = skeleton.rest_offsets().norm(dim=-1)
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:  # parents come first, so that all ways to the parent are known
            way = lengths[parent, :joint] + bones[joint]
            lengths[joint, :joint] = lengths[:joint, joint] = way
    return lengths


def _worst_pair(
    controls: DenseControls, reach: Float[Tensor, "J J"], reached: Bool[Tensor, "T"]
) -> tuple[int, int, int, float, float] | None:
    """Frame, two joints, their distance and their reach, where the excess is largest.

    Clears ``reached`` in every frame with an excess.
    """
    targets, mask = controls.targets.double(), controls.mask
    used = mask.any(-1).any(0).nonzero()[:, 0].tolist()
    worst, excess = None, 0.0
    for place, first in enumerate(used):
        for second in used[place + 1 :]:
            both = mask[:, first] & mask[:, second]
            distance = ((targets[:, first] - targets[:, second]) * both).norm(dim=-1)
            limit = reach[first, second].item()
            excesses = distance - limit * (1 + _SLACK)
            reached &= excesses <= 0
            beyond, frame = excesses.max(0)
            if beyond > excess:
                excess = beyond.item()
                worst = int(frame), first, second, distance[frame].item(), limit
    return worst
