"""Features of moved joints: what the network made, changed by what the joints changed by."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.motion.layout import feature_layout
from controlmm.motion.rotations import quat_between, quat_rotate, quat_to_matrix, rot6d_to_matrix
from controlmm.motion.skeleton import Skeleton
from controlmm.ops import recover_joints


def refit_features(
    features: Float[Tensor, "T D"], joints: Float[Tensor, "T J 3"], skeleton: Skeleton
) -> Float[Tensor, "T D"]:
    """De-normalised features that decode to ``joints``, whose root starts at x = z = 0.

    Headings and foot contacts stay. Velocities change by what those of the joints change by, and a bone's
    rotation is turned by what the bone itself turned by: what no position depends on stays the network's.
    Rotations and velocities computed anew from positions raise FID by a tenth to a quarter, and rotations
    jump where an arm or a thigh points away from its rest direction.
    """
    layout, fitted, joints = feature_layout(skeleton), features.double().clone(), joints.double()
    half_turn = torch.cat([fitted.new_zeros(1), fitted[:-1, layout.root_yaw_velocity].flatten().cumsum(0)])
    zero = torch.zeros_like(half_turn)
    heading = torch.stack([half_turn.cos(), zero, half_turn.sin(), zero], dim=-1)  # (T, 4)
    before = recover_joints(fitted[None], joints=skeleton.num_joints)[0]
    rotations = _turned_along(fitted[:, layout.local_rotations], before, joints, heading, skeleton)
    fitted[:, layout.local_rotations] = rotations
    step, root = (joints - before).diff(dim=0), joints[:, 0]
    fitted[:-1, layout.root_velocity] += quat_rotate(heading[1:], step[:, 0])[:, [0, 2]]
    fitted[:, layout.root_height] = root[:, 1:2]
    on_ground = root[:, None] * root.new_tensor([1, 0, 1])
    here = heading[:, None]
    fitted[:, layout.local_positions] = quat_rotate(here, joints[:, 1:] - on_ground).flatten(1)
    fitted[:-1, layout.joint_velocities] += quat_rotate(here[:-1], step).flatten(1)
    return fitted.to(features.dtype)


def _turned_along(
    rotations: Float[Tensor, "T R"],
    before: Float[Tensor, "T J 3"],
    after: Float[Tensor, "T J 3"],
    heading: Float[Tensor, "T 4"],
    skeleton: Skeleton,
) -> Float[Tensor, "T R"]:
    """Local rotations in six numbers a joint, each bone turned the shortest way from before to after.

    The six numbers of a decoder are no unit vectors; they are turned as they are.
    """
    six = rotations.unflatten(1, (-1, 6))
    local, columns = rot6d_to_matrix(six), six.unflatten(-1, (2, 3)).mT  # (T, J-1, 3, 3), (T, J-1, 3, 2)
    turned, facing = columns.clone(), quat_to_matrix(heading)
    parents = list(skeleton.parents[1:])
    turns = quat_to_matrix(quat_between(*(x[:, 1:] - x[:, parents] for x in (before, after))))
    chains = sorted(skeleton.chains, key=len, reverse=True)  # each starts from the heading, as in HumanML3D
    old = new = facing[:, None].expand(-1, len(chains), -1, -1)
    for depth in range(1, len(chains[0])):
        bones = [chain[depth] - 1 for chain in chains if len(chain) > depth]
        own, new = local[:, bones], new[:, : len(bones)]
        old = old[:, : len(bones)] @ own
        moved = turns[:, bones] @ old
        turned[:, bones] = new.mT @ moved @ own.mT @ columns[:, bones]
        new = moved
    fitted: Tensor = turned.mT.flatten(1)
    return fitted
