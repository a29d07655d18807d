"""How near joints come to obstacles: of targets before generation, of motions after it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.controls.avoid import Avoid
from controlmm.controls.dense import DenseControls
from controlmm.motion.body_points import body_points
from controlmm.motion.skeleton import Skeleton
from controlmm.ops import pack_obstacles, signed_distances

_METRE = {"m": 1.0, "mm": 1000.0}  # in a skeleton's unit


def penetration(
    joints: Float[Tensor, "S T J 3"], obstacles: Sequence[Avoid], skeleton: Skeleton
) -> Float[Tensor, "S"]:
    """Greatest depth in metres to which a joint's ball enters an obstacle in each clip; 0: none does.

    Margins do not count. Every obstacle is measured with the joints that avoid it.

    Args:
        joints: Global positions in the skeleton's unit, in the world of the obstacles.
        obstacles: In metres.
        skeleton: Joints and unit.

    Raises:
        ValueError: If an obstacle names a joint or a frame that is not there.
    """
    depth = joints.new_zeros(len(joints))
    for obstacle in obstacles:
        room = clearance(joints / _METRE[skeleton.unit], obstacle, skeleton)
        depth = torch.maximum(depth, -room.flatten(1).amin(1))
    return depth


def check_targets_clear(controls: DenseControls, obstacles: Sequence[Avoid], skeleton: Skeleton) -> None:
    """Refuse targets inside obstacles; warn of targets within a margin.

    Only targets with all three axes are looked at: with a free axis the joint may pass beside.

    Raises:
        ValueError: Naming the first such target, and by how much it is inside.
    """
    is_point = controls.mask.all(-1)
    for index, obstacle in enumerate(obstacles):
        room, frame, name = _nearest(controls.targets, is_point, obstacle, skeleton)
        who = f"obstacle {index} ({obstacle.label})"
        if room < 0:
            raise ValueError(
                f"The target of {name} at frame {frame} lies {-room:.3f} m inside {who}, which that joint "
                "must avoid. Move one of them, or leave the joint out of the obstacle's `joints`."
            )
        if room < obstacle.margin:
            warnings.warn(
                f"The target of {name} at frame {frame} is {room:.3f} m from {who}, nearer than its margin "
                f"of {obstacle.margin:g} m: the motion will miss one of them by a little.",
                stacklevel=4,
            )


def check_kept_clear(
    joints: Float[Tensor, "T J 3"],
    kept: Bool[Tensor, "T J"],
    obstacles: Sequence[Avoid],
    skeleton: Skeleton,
    *,
    slack: float,
) -> None:
    """Refuse joints of a motion that are to stay where they are, inside an obstacle.

    Args:
        joints: In the skeleton's unit, in the world of the obstacles.
        kept: Which of them stay.
        obstacles: In metres.
        skeleton: Joints and unit.
        slack: Metres that they may be inside.

    Raises:
        ValueError: Naming the deepest.
    """
    for index, obstacle in enumerate(obstacles):
        room, frame, name = _nearest(joints, kept, obstacle, skeleton)
        if room < -slack:
            raise ValueError(
                f"What is kept has {name} at frame {frame} {-room:.3f} m inside obstacle {index} "
                f"({obstacle.label}), which that joint must avoid. Keep less, move the obstacle, or leave "
                "the joint out of its `joints`."
            )


def _nearest(
    points: Float[Tensor, "T J 3"], counts: Bool[Tensor, "T J"], obstacle: Avoid, skeleton: Skeleton
) -> tuple[float, int, str]:
    """Room in metres of the point nearest to an obstacle or deepest in it, its frame and its joint."""
    joints = obstacle.joint_indices(skeleton) or tuple(range(skeleton.num_joints))
    rooms = clearance(points[None] / _METRE[skeleton.unit], obstacle, skeleton)[0]
    rooms = rooms[:, : len(joints)].masked_fill(~counts[:, joints], torch.inf)
    frame, column = divmod(int(rooms.argmin()), len(joints))
    return float(rooms[frame, column]), frame, skeleton.joint_names[joints[column]]


def clearance(
    joints: Float[Tensor, "S T J 3"], obstacle: Avoid, skeleton: Skeleton
) -> Float[Tensor, "S T P"]:
    """Room in metres between an obstacle and the balls of the joints that avoid it, negative inside.

    Args:
        joints: Global positions in metres, in the world of the obstacle.
        obstacle: Still, or moving over the T frames.
        skeleton: Joints that the obstacle's names mean. ``P`` of them avoid it, or the points of the whole
            body, the joints first.
    """
    packed = pack_obstacles([obstacle.over(joints.shape[1])], dtype=joints.dtype)
    chosen = obstacle.joint_indices(skeleton)
    avoiding = body_points(joints, skeleton) if chosen is None else joints[:, :, list(chosen)]
    return signed_distances(avoiding, packed)[..., 0] - obstacle.joint_radius
