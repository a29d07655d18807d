"""Features of moved joints: what the network made, changed by what the joints changed by."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.motion.heading import turned
from controlmm.motion.layout import feature_layout
from controlmm.motion.skeleton import Skeleton
from controlmm.ops import recover_joints, swing_rotations


def refit_features(
    features: Float[Tensor, "T D"], joints: Float[Tensor, "T J 3"], skeleton: Skeleton
) -> Float[Tensor, "T D"]:
    """De-normalised features that decode to ``joints``, whose root starts at x = z = 0.

    Headings and foot contacts stay. Velocities change by what those of the joints change by, and a bone's
    rotation is turned by what the bone itself turned by: what no position depends on stays the network's.
    Rotations and velocities computed anew from positions raise FID by a tenth to a quarter, and rotations
    jump where an arm or a thigh points away from its rest direction.
    """
    layout, fitted = feature_layout(skeleton), features.to(torch.float64, copy=True)
    joints = joints.double()
    half_turn = torch.cat([fitted.new_zeros(1), fitted[:-1, layout.root_yaw_velocity].flatten().cumsum(0)])
    zero, yaw = torch.zeros_like(half_turn), 2 * half_turn[:, None]
    heading = torch.stack([half_turn.cos(), zero, half_turn.sin(), zero], dim=-1)  # (T, 4)
    before = recover_joints(fitted[None], joints=skeleton.num_joints)[0]
    rotations = fitted[:, layout.local_rotations].unflatten(1, (-1, 6))
    swung = swing_rotations(rotations, before, joints, heading, chains=skeleton.chains)
    fitted[:, layout.local_rotations] = swung.flatten(1)
    step, root = (joints - before).diff(dim=0), joints[:, 0]
    fitted[:-1, layout.root_velocity] += turned(step[:, 0], yaw[1:, 0])[:, [0, 2]]
    fitted[:, layout.root_height] = root[:, 1:2]
    on_ground = root[:, None] * root.new_tensor([1, 0, 1])
    fitted[:, layout.local_positions] = turned(joints[:, 1:] - on_ground, yaw).flatten(1)
    fitted[:-1, layout.joint_velocities] += turned(step, yaw[:-1]).flatten(1)
    return fitted.to(features.dtype)
