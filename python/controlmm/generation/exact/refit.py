"""Features of moved joints: the way back from positions, with the heading that the features had."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.motion.features import inverse_kinematics
from controlmm.motion.layout import feature_layout
from controlmm.motion.rotations import matrix_to_rot6d, quat_rotate, quat_to_matrix
from controlmm.motion.skeleton import Skeleton


def refit_features(
    features: Float[Tensor, "T D"], joints: Float[Tensor, "T J 3"], skeleton: Skeleton
) -> Float[Tensor, "T D"]:
    """De-normalised features that decode to ``joints``, whose root starts at x = z = 0.

    Headings and foot contacts stay; the velocities of the last frame, which no position depends on, too.
    """
    layout, fitted, joints = feature_layout(skeleton), features.double().clone(), joints.double()
    half_turn = torch.cat([fitted.new_zeros(1), fitted[:-1, layout.root_yaw_velocity].flatten().cumsum(0)])
    zero = torch.zeros_like(half_turn)
    heading = torch.stack([half_turn.cos(), zero, half_turn.sin(), zero], dim=-1)  # (T, 4)
    step, root = joints.diff(dim=0), joints[:, 0]
    fitted[:-1, layout.root_velocity] = quat_rotate(heading[1:], step[:, 0])[:, [0, 2]]
    fitted[:, layout.root_height] = root[:, 1:2]
    on_ground = root[:, None] * root.new_tensor([1, 0, 1])
    here = heading[:, None]
    fitted[:, layout.local_positions] = quat_rotate(here, joints[:, 1:] - on_ground).flatten(1)
    rotations = inverse_kinematics(joints, heading, skeleton)[:, 1:]
    fitted[:, layout.local_rotations] = matrix_to_rot6d(quat_to_matrix(rotations)).flatten(1)
    fitted[:-1, layout.joint_velocities] = quat_rotate(here[:-1], step).flatten(1)
    return fitted.to(features.dtype)
