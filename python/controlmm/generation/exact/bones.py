"""Bones of the right length again, targets kept: inverse kinematics of a clip, then of each frame."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.motion.skeleton import Skeleton
from controlmm.ops import frame_bones, smooth_bones

_STEPS, _SMOOTH_ENOUGH = 3, 1e-3  # of the whole clip; metres of the worst bone
_FRAME_STEPS, _ENOUGH = 40, 1e-5  # of each frame


def restore_bones(
    joints: Float[Tensor, "T J 3"],
    lengths: Float[Tensor, "J"],
    held: Bool[Tensor, "T J 3"],
    planted: Bool[Tensor, "T J"],
    skeleton: Skeleton,
) -> Float[Tensor, "T J 3"]:
    """The joints moved little and smoothly so that every bone has its length; float64.

    First all frames together, up to some millimetres, and then each frame finds the nearest pose. Held
    coordinates do not move, planted joints stand; where bones cannot span what is held, lengths stay wrong.

    Args:
        joints: Positions.
        lengths: Of the bone from every joint to its parent; that of the root is not used.
        held: Coordinates that stay.
        planted: Joints that stand from a frame to the next.
        skeleton: The hierarchy.
    """
    start, lengths, metre = joints.double(), lengths.double(), 1 / skeleton.metres
    parents, feet = skeleton.parents, skeleton.foot_joints
    toes = (skeleton.left_foot[1], skeleton.right_foot[1])  # an ankle turns about them
    smooth = smooth_bones(
        start, lengths, held, planted,
        parents=parents, feet=feet, toes=toes, enough=_SMOOTH_ENOUGH * metre, steps=_STEPS,
    )  # fmt: skip
    return frame_bones(
        smooth, lengths, held, planted,
        parents=parents, feet=feet, enough=_ENOUGH * metre, steps=_FRAME_STEPS, metre=metre,
    )  # fmt: skip
