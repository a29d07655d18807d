"""New motions out of recorded ones: other speeds, bent ways, two clips in a row. Bones keep their lengths.

All functions take and return global joints in metres (KIT-ML: millimetres), Y up, at the skeleton's rate.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.motion.features import bone_lengths
from controlmm.motion.heading import heading, turned
from controlmm.motion.skeleton import skeleton_of_joints

BLEND_FRAMES = 8  # over which the first clip fades into the second
_WAY_SMOOTHING = 11  # frames; the heading of a bent way must not follow the sway of the steps


def at_speed(joints: Float[Tensor, "F J 3"], factor: float) -> Float[Tensor, "G J 3"]:
    """The motion ``factor`` times as fast: the root on straight lines between frames, bones turned."""
    frames = len(joints)
    count = int((frames - 1) / factor + 1e-6) + 1
    times = (torch.arange(count, dtype=joints.dtype) * factor).clamp(max=frames - 1)
    before = times.floor().long().clamp(max=frames - 2)
    share = (times - before)[:, None, None]
    return _with_bone_lengths(joints[before].lerp(joints[before + 1], share), joints)


def along_bent_way(joints: Float[Tensor, "F J 3"], degrees: float) -> Float[Tensor, "F J 3"]:
    """The motion with its way bent by ``degrees`` in all, to the left if positive.

    Heading and steps turn in proportion to the way covered, so somebody who stands does not turn.
    """
    ground = joints[:, :1] * joints.new_tensor([1, 0, 1])
    covered = torch.cat([ground.new_zeros(1), _smooth(ground[:, 0]).diff(dim=0).norm(dim=1).cumsum(0)])
    yaw = math.radians(degrees) * covered / covered[-1].clamp(min=1e-9)
    steps = turned(ground.diff(dim=0), (yaw[1:] + yaw[:-1])[:, None] / 2)
    bent = torch.cat([ground[:1], ground[:1] + steps.cumsum(0)])
    return turned(joints - ground, yaw[:, None]) + bent


def joined(first: Float[Tensor, "F J 3"], second: Float[Tensor, "G J 3"]) -> Float[Tensor, "H J 3"]:
    """``second`` after ``first``, set down where and as ``first`` ends; ``F + G - BLEND_FRAMES`` frames.

    Raises:
        ValueError: If a clip is shorter than the blend.
    """
    blend = BLEND_FRAMES
    if min(len(first), len(second)) < blend:
        raise ValueError(
            f"Both clips need at least {blend} frames to be joined, got {len(first)} and {len(second)}."
        )
    skeleton = skeleton_of_joints(first.shape[1])
    end, middle = first[-blend:], blend // 2
    yaw = heading(end[middle], skeleton) - heading(second[middle], skeleton)
    flat = first.new_tensor([1, 0, 1])
    second = turned(second - second[middle, 0] * flat, yaw) + end[middle, 0] * flat
    share = torch.linspace(0, 1, blend + 2, dtype=first.dtype)[1:-1, None, None]
    share = share.square() * (3 - 2 * share)  # smooth at both ends
    blended = _with_bone_lengths(end.lerp(second[:blend], share), first)
    return torch.cat([first[:-blend], blended, second[blend:]])


def pose_distance(first: Float[Tensor, "F J 3"], second: Float[Tensor, "G J 3"]) -> float:
    """Mean distance of the joints at the middle of a blend, heading and place taken out, heights kept."""
    skeleton = skeleton_of_joints(first.shape[1])
    poses = []
    for pose in (first[-BLEND_FRAMES // 2], second[BLEND_FRAMES // 2]):
        on_spot = pose - pose[0] * pose.new_tensor([1, 0, 1])
        poses.append(turned(on_spot, -heading(pose, skeleton)))
    return float((poses[0] - poses[1]).norm(dim=-1).mean())


def _with_bone_lengths(
    joints: Float[Tensor, "F J 3"], like: Float[Tensor, "G J 3"]
) -> Float[Tensor, "F J 3"]:
    """``joints`` with every bone stretched to the mean length that it has in ``like``, root left alone."""
    skeleton = skeleton_of_joints(joints.shape[1])
    wanted = bone_lengths(like, skeleton).mean(0)
    placed = [joints[:, 0]]
    for joint, parent in enumerate(skeleton.parents[1:], start=1):
        bone = torch.nn.functional.normalize(joints[:, joint] - joints[:, parent], dim=-1)
        placed.append(placed[parent] + bone * wanted[joint])
    return torch.stack(placed, dim=1)


def _smooth(places: Float[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    half = _WAY_SMOOTHING // 2
    padded = torch.cat([places[:1].expand(half, -1), places, places[-1:].expand(half, -1)])
    return padded.unfold(0, _WAY_SMOOTHING, 1).mean(-1)
