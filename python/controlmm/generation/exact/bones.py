"""Bones of the right length again, targets kept: inverse kinematics of a clip, then of each frame."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.generation.exact.projection import STIFFNESS, graph_laplacian
from controlmm.generation.exact.smooth_bones import bone_slopes, smooth_bones
from controlmm.motion.skeleton import Skeleton

_ITERATIONS = 20
_ENOUGH = 1e-5  # metres of the worst bone
_HELD, _PLANTED, _FEET = 1e9, 1e4, 1e3  # resistance of a coordinate against change, free ones have about 1
_SLACK = 1e-9  # so that a chain that cannot reach gives the nearest pose instead of none


def restore_bones(
    joints: Float[Tensor, "T J 3"],
    lengths: Float[Tensor, "J"],
    held: Bool[Tensor, "T J 3"],
    planted: Bool[Tensor, "T J"],
    skeleton: Skeleton,
) -> Float[Tensor, "T J 3"]:
    """The joints moved little and smoothly so that every bone has its length; float64.

    First all frames together, up to a fraction of a millimetre, and then each frame finds the nearest pose.
    Held coordinates do not move, planted joints stand; where bones cannot span what is held, lengths stay
    wrong.

    Args:
        joints: Positions.
        lengths: Of the bone from every joint to its parent; that of the root is not used.
        held: Coordinates that stay.
        planted: Joints that stand from a frame to the next.
        skeleton: The hierarchy.
    """
    smooth = smooth_bones(joints, lengths, held, planted, skeleton)
    return _restored(smooth, lengths, held, planted, skeleton)


def _restored(
    joints: Float[Tensor, "T J 3"],
    lengths: Float[Tensor, "J"],
    held: Bool[Tensor, "T J 3"],
    planted: Bool[Tensor, "T J"],
    skeleton: Skeleton,
) -> Float[Tensor, "T J 3"]:
    """Newton's method on the constraints, each frame by itself."""
    count = joints.shape[1]
    start = moved = joints.double()
    resistance = torch.kron(STIFFNESS * graph_laplacian(skeleton) + torch.eye(count), torch.eye(3))
    stays = _PLANTED * planted
    stays[:, list(skeleton.foot_joints)] += _FEET  # else knees would keep their place and feet would slide
    extra = stays[..., None] + _HELD * held
    yielding = torch.linalg.inv(resistance + torch.diag_embed(extra.double().flatten(1)))  # (T, 3J, 3J)
    for _ in range(_ITERATIONS):
        slopes, short = bone_slopes(moved, lengths, skeleton)
        if short.abs().max() < _ENOUGH:
            break
        answers = yielding @ slopes.mT  # (T, 3J, J - 1)
        matrix = slopes @ answers + _SLACK * torch.eye(count - 1)
        forces = torch.linalg.solve(matrix, short[..., None])
        moved = moved + (answers @ forces).unflatten(1, (count, 3))[..., 0]
    return torch.where(held, start, moved)
