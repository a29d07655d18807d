"""Features of moved joints: the way back from positions, with the heading that the features had."""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.motion.layout import feature_layout
from controlmm.motion.rotations import (
    matrix_to_rot6d,
    quat_between,
    quat_rotate,
    quat_to_matrix,
    rot6d_to_matrix,
)
from controlmm.motion.skeleton import Skeleton
from controlmm.ops import recover_joints


def refit_features(
    features: Float[Tensor, "T D"], joints: Float[Tensor, "T J 3"], skeleton: Skeleton
) -> Float[Tensor, "T D"]:
    """De-normalised features that decode to ``joints``, whose root starts at x = z = 0.

    Headings and foot contacts stay; the velocities of the last frame, which no position depends on, too. A
    bone's rotation is turned by what the bone itself turned by: rotations found anew from positions jump
    where an arm or a thigh points away from its rest direction, and raise FID by a quarter.
    """
    layout, fitted, joints = feature_layout(skeleton), features.double().clone(), joints.double()
    half_turn = torch.cat([fitted.new_zeros(1), fitted[:-1, layout.root_yaw_velocity].flatten().cumsum(0)])
    zero = torch.zeros_like(half_turn)
    heading = torch.stack([half_turn.cos(), zero, half_turn.sin(), zero], dim=-1)  # (T, 4)
    before = recover_joints(fitted[None], joints=skeleton.num_joints)[0]
    rotations = _turned_along(fitted[:, layout.local_rotations], before, joints, heading, skeleton)
    fitted[:, layout.local_rotations] = rotations
    step, root = joints.diff(dim=0), joints[:, 0]
    fitted[:-1, layout.root_velocity] = quat_rotate(heading[1:], step[:, 0])[:, [0, 2]]
    fitted[:, layout.root_height] = root[:, 1:2]
    on_ground = root[:, None] * root.new_tensor([1, 0, 1])
    here = heading[:, None]
    fitted[:, layout.local_positions] = quat_rotate(here, joints[:, 1:] - on_ground).flatten(1)
    fitted[:-1, layout.joint_velocities] = quat_rotate(here[:-1], step).flatten(1)
    return fitted.to(features.dtype)


def _turned_along(
    rotations: Float[Tensor, "T R"],
    before: Float[Tensor, "T J 3"],
    after: Float[Tensor, "T J 3"],
    heading: Float[Tensor, "T 4"],
    skeleton: Skeleton,
) -> Float[Tensor, "T R"]:
    """Local rotations in six numbers a joint, each bone turned the shortest way from before to after."""
    local = rot6d_to_matrix(rotations.unflatten(1, (-1, 6)))
    turned, facing = local.clone(), quat_to_matrix(heading)
    for chain in skeleton.chains:  # each starts again from the heading, as in HumanML3D
        old = new = facing
        for parent, child in pairwise(chain):
            bones = (
                torch.nn.functional.normalize(x[:, child] - x[:, parent], dim=-1) for x in (before, after)
            )
            old = old @ local[:, child - 1]
            moved = quat_to_matrix(quat_between(*bones)) @ old
            turned[:, child - 1] = new.mT @ moved
            new = moved
    return matrix_to_rot6d(turned).flatten(1)
