"""Coordinates put on their targets by the smallest change that is smooth along the skeleton and in time."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.motion.skeleton import Skeleton
from controlmm.ops import project_change


def project_on_targets(
    joints: Float[Tensor, "T J 3"],
    targets: Float[Tensor, "T J 3"],
    mask: Bool[Tensor, "T J 3"],
    planted: Bool[Tensor, "T J"],
    skeleton: Skeleton,
) -> Float[Tensor, "T J 3"]:
    """The joints with the masked coordinates on their targets, all else moved least; float64.

    Args:
        joints: Positions.
        targets: Wanted positions, in the same frame.
        mask: The controlled coordinates.
        planted: Joints that stand in this frame and the next; what moves them should move them alike.
        skeleton: Whose bones tie joints together.
    """
    joints, targets = joints.double(), targets.double()
    lacks = torch.where(mask, targets - joints, 0)
    moved = joints + project_change(lacks, mask, planted, parents=skeleton.parents)
    return torch.where(mask, targets, moved)
