"""What editing minimises beside the distance to targets: functions of the joints, one value a clip."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.controls import Avoid, Objective
from controlmm.controls.shape_fields import placed, spread
from controlmm.motion.body_points import body_points
from controlmm.motion.skeleton import Skeleton
from controlmm.ops import PackedObstacles, masked_consistency_loss, obstacle_loss, pack_obstacles

OBSTACLE_WEIGHT = 0.003  # m^2 of squared error for each metre of summed depth


class JointTerm(Protocol):
    """A differentiable function of the joints that is added to a control objective."""

    def values(self, joints: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B"]:
        """Weighted values; ``joints`` in the networks' frame. No clip's value depends on another's."""

    def select(self, clips: Int[Tensor, " N"]) -> JointTerm:
        """The same term for some of the clips."""


@dataclass(frozen=True, eq=False)
class ObstacleTerm:
    """Depth by which joints enter obstacles, summed over a clip (ControlMM, equation 9).

    Attributes:
        obstacles: Packed in the networks' frame, for every padded frame.
        skeleton: The joints.
        joints: Indices of the joints that count; ``None``: all joints and the bones between them.
        radius: Radius of a joint plus the margin, in the skeleton's unit.
        lengths: (B,) frames of each clip.
        weight: Factor.
    """

    obstacles: PackedObstacles
    skeleton: Skeleton
    joints: tuple[int, ...] | None
    radius: float
    lengths: Int[Tensor, "B"]
    weight: float

    def values(self, joints: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B"]:
        """See :class:`JointTerm`."""
        depth = obstacle_loss(
            body_points(joints, self.skeleton) if self.joints is None else joints,
            self.obstacles,
            joint_radius=self.radius,
            joint_indices=self.joints,
            lengths=self.lengths,
            reduction="sum",
        )
        return self.weight * depth

    def select(self, clips: Int[Tensor, " N"]) -> ObstacleTerm:
        """See :class:`JointTerm`."""
        return replace(self, lengths=self.lengths[clips])


@dataclass(frozen=True, eq=False)
class ObjectiveTerm:
    """An objective of the caller's, on the frames of each clip in the caller's world.

    Attributes:
        objective: What to minimise.
        is_batched: Whether it takes many clips at once, see :meth:`Objective.check`.
        lengths: (B,) frames of each clip.
        origin: (3,) where the networks' frame stands in the caller's world.
    """

    objective: Objective
    is_batched: bool
    lengths: Int[Tensor, "B"]
    origin: Float[Tensor, "3"]

    def values(self, joints: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B"]:
        """See :class:`JointTerm`."""
        joints = joints + self.origin
        result = joints.new_zeros(len(joints))
        for length in self.lengths.unique().tolist():
            rows = (self.lengths == length).nonzero()[:, 0]
            values = self.objective.values(joints[rows, :length], is_batched=self.is_batched)
            result = result.index_add(0, rows, values)
        return result

    def select(self, clips: Int[Tensor, " N"]) -> ObjectiveTerm:
        """See :class:`JointTerm`."""
        return replace(self, lengths=self.lengths[clips])


@dataclass(frozen=True, eq=False)
class HeldTerm:
    """Mean squared error of joints that stay where they were, in m^2: targets that only editing sees.

    The control branch takes poses that are held all around an interval as a reason to go on as before; with
    those in a term it follows the text.

    Attributes:
        targets: (B, T, J, 3) in the networks' frame, T the padded frames.
        mask: (B, T, J, 3) what is held.
    """

    targets: Float[Tensor, "B T J 3"]
    mask: Bool[Tensor, "B T J 3"]

    def values(self, joints: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B"]:
        """See :class:`JointTerm`."""
        return masked_consistency_loss(joints, self.targets, self.mask, norm="mse", reduction="clip")

    def select(self, clips: Int[Tensor, " N"]) -> HeldTerm:
        """See :class:`JointTerm`."""
        return HeldTerm(self.targets[clips], self.mask[clips])


@dataclass(frozen=True, eq=False)
class Placed:
    """A term of the world, of motions that stand turned and moved there.

    Attributes:
        term: What is minimised.
        turn: (3, 3) from the networks' frame to the world.
        offset: (3,) of the turned frame in the world.
    """

    term: JointTerm
    turn: Float[Tensor, "3 3"]
    offset: Float[Tensor, "3"]

    def values(self, joints: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B"]:
        """See :class:`JointTerm`."""
        return self.term.values(joints @ self.turn.T + self.offset)

    def select(self, clips: Int[Tensor, " N"]) -> Placed:
        """See :class:`JointTerm`."""
        return replace(self, term=self.term.select(clips))


@dataclass(frozen=True, eq=False)
class OnFloor:
    """A term of motions that will be stood on the floor: it sees them there already.

    Attributes:
        term: What is minimised.
        lengths: (B,) frames of each clip.
    """

    term: JointTerm
    lengths: Int[Tensor, "B"]

    def values(self, joints: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B"]:
        """See :class:`JointTerm`. The shift is part of the gradient: sinking leads under nothing."""
        padding = torch.arange(joints.shape[1]) >= self.lengths[:, None]
        lowest = joints[..., 1].masked_fill(padding[..., None], torch.inf).amin((1, 2))
        shift = lowest[:, None, None, None] * joints.new_tensor([0.0, 1.0, 0.0])
        return self.term.values(joints - shift)

    def select(self, clips: Int[Tensor, " N"]) -> OnFloor:
        """See :class:`JointTerm`."""
        return OnFloor(self.term.select(clips), self.lengths[clips])


def is_callers(term: JointTerm) -> bool:
    """Whether a function of the caller's is in it, which may look at a whole batch and knows no threads."""
    while isinstance(term, Placed | OnFloor):
        term = term.term
    return isinstance(term, ObjectiveTerm)


def obstacle_terms(
    obstacles: Sequence[Avoid],
    *,
    lengths: Int[Tensor, "B"],
    frames: int,
    padded: int,
    skeleton: Skeleton,
    origin: Float[Tensor, "3"],
    weight: float = OBSTACLE_WEIGHT,
) -> tuple[ObstacleTerm, ...]:
    """One term for all obstacles that the same joints avoid by the same distance.

    Args:
        obstacles: In the caller's world, metres.
        lengths: (B,) frames of each clip.
        frames: Frames over which moving obstacles move; then they stand still.
        padded: Frames of the padded batch; may be fewer.
        skeleton: Joints and unit.
        origin: (3,) where the networks' frame stands in the caller's world, in the skeleton's unit.
        weight: Factor of the terms.

    Raises:
        ValueError: If an obstacle names a joint or a frame that is not there.
    """
    unit = 1 / skeleton.metres
    groups: dict[tuple[tuple[int, ...] | None, float], list[Avoid]] = {}
    for obstacle in obstacles:
        key = obstacle.joint_indices(skeleton), unit * (obstacle.margin + obstacle.joint_radius)
        groups.setdefault(key, []).append(obstacle)
    return tuple(
        ObstacleTerm(
            pack_obstacles(
                [
                    spread(placed(avoid.over(frames), offset=-origin / unit, scale=unit), None, padded)
                    for avoid in avoids
                ]
            ),
            skeleton,
            joints,
            radius,
            lengths,
            weight,
        )
        for (joints, radius), avoids in groups.items()
    )
