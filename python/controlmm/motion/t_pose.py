"""The T-pose that a skeleton file rests in: arms out along X, legs down, feet forward, spine and head up.

HumanML3D's own rest directions let the arms hang and bend the head forward, and they are unit axes, while
the real hips and collar bones are oblique. Animation programs need a T-pose, and a rigid fit needs the real
angles between the bones of a joint with several children, so those are measured on the clip.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.motion.rotations import quat_conjugate, quat_rotate
from controlmm.motion.skeleton import Skeleton
from controlmm.motion.wahba import best_rotation

# Ankle to ball of a foot that stands flat on the floor: 25 degrees down, the mean over HumanML3D clips.
_FOOT = (0.0, -math.sin(math.radians(25)), math.cos(math.radians(25)))
# Neck to the base of the skull of someone who looks ahead. Straight up, figures would stare at the floor.
_HEAD = (0.0, math.cos(math.radians(40)), math.sin(math.radians(40)))
_UP = (0.0, 1.0, 0.0)
_PROCRUSTES_ROUNDS = 3
_TINY = 1e-9


def branching_joints(skeleton: Skeleton) -> tuple[int, ...]:
    """Joints with several children: the pelvis and the chest."""
    return tuple(j for j in range(skeleton.num_joints) if skeleton.parents.count(j) > 1)


def children_of(joint: int, skeleton: Skeleton) -> tuple[int, ...]:
    """The joints whose parent is ``joint``, in index order."""
    return tuple(j for j, parent in enumerate(skeleton.parents) if parent == joint)


def arm_chains(skeleton: Skeleton) -> tuple[tuple[int, ...], ...]:
    """The two chains that start at the chest."""
    return tuple(chain for chain in skeleton.chains if chain[0] != 0)


def leg_chains(skeleton: Skeleton) -> tuple[tuple[int, ...], ...]:
    """The two chains that end in a foot."""
    return tuple(chain for chain in skeleton.chains if chain[-1] in skeleton.foot_joints)


def trunk_chain(skeleton: Skeleton) -> tuple[int, ...]:
    """The chain from the root to the head."""
    sided = (*arm_chains(skeleton), *leg_chains(skeleton))
    return next(chain for chain in skeleton.chains if chain not in sided)


def t_pose_directions(skeleton: Skeleton) -> Float[Tensor, "J 3"]:
    """Unit vector from the parent to every joint in the T-pose (left +X, up +Y, front +Z); root zero."""
    right_hip, left_hip, _, left_shoulder = skeleton.facing
    directions = torch.tensor(skeleton.directions, dtype=torch.float64)
    for joint in trunk_chain(skeleton)[1:]:
        is_upright = skeleton.directions[joint] == _UP
        directions[joint] = torch.tensor(_UP if is_upright else _HEAD, dtype=torch.float64)
    for chain in arm_chains(skeleton):
        side = 1.0 if left_shoulder in chain else -1.0
        directions[list(chain[1:])] = torch.tensor([side, 0.0, 0.0], dtype=torch.float64)
    directions[left_hip] = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    directions[right_hip] = torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64)
    for chain in leg_chains(skeleton):
        directions[list(chain[4:])] = torch.tensor(_FOOT, dtype=torch.float64)
    return directions


def t_pose_offsets(
    joints: Float[Tensor, "T J 3"], skeleton: Skeleton, *, lengths: Float[Tensor, "J"]
) -> Float[Tensor, "J 3"]:
    """Offset of every joint from its parent in the T-pose of the body that moves in ``joints``.

    Args:
        joints: Positions in the skeleton's unit, Y up, float64.
        skeleton: Hierarchy of the joints.
        lengths: Bone lengths that the offsets get; 0 for the root.
    """
    directions = t_pose_directions(skeleton)
    for joint in branching_joints(skeleton):
        children = list(children_of(joint, skeleton))
        shape = _mean_shape(
            joints[:, children] - joints[:, [joint]], directions[children] * lengths[children, None]
        )
        norms = shape.norm(dim=-1, keepdim=True)
        upright = _upright(shape, children, skeleton)
        directions[children] = torch.where(
            norms > _TINY, upright / norms.clamp_min(_TINY), directions[children]
        )
    return directions * lengths[:, None]


def _mean_shape(bones: Float[Tensor, "T C 3"], guess: Float[Tensor, "C 3"]) -> Float[Tensor, "C 3"]:
    """Generalised Procrustes mean of one joint's child bones: their common shape, whatever way they turn."""
    for _ in range(_PROCRUSTES_ROUNDS):
        rotations = best_rotation(guess, bones)
        guess = quat_rotate(quat_conjugate(rotations)[:, None], bones).mean(0)
    return guess


def _upright(shape: Float[Tensor, "C 3"], children: list[int], skeleton: Skeleton) -> Float[Tensor, "C 3"]:
    """``shape`` turned so that right to left is +X and the middle child lies straight above the pair."""
    trunk = next(i for i, child in enumerate(children) if child in trunk_chain(skeleton))
    sides = {i: t_pose_directions(skeleton)[child, 0] for i, child in enumerate(children) if i != trunk}
    left, right = max(sides, key=lambda i: float(sides[i])), min(sides, key=lambda i: float(sides[i]))
    across = shape[left] - shape[right]
    up = shape[trunk] - (shape[left] + shape[right]) / 2
    front = torch.linalg.cross(across, up)
    if front.norm() < _TINY * (1 + across.norm() * up.norm()):
        return shape
    rows = [across, torch.linalg.cross(front, across), front]
    return shape @ torch.stack([row / row.norm() for row in rows]).T
