"""Obstacles that joints keep out of: a shape, who avoids it, and by how much."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from numbers import Real

import torch
from jaxtyping import Int
from torch import Tensor

from controlmm.controls.checks import check_joint, parse_frames, resolve_joint
from controlmm.controls.shape_fields import moving_fields, placed, shape_name, spread
from controlmm.motion.skeleton import Skeleton
from controlmm.ops import Obstacle

MARGIN = 0.05  # metres; bodies are thicker than their joints, and editing stops near the surface it aims at


@dataclass(frozen=True, eq=False, init=False)
class Avoid:
    """Keeps joints out of a shape.

    A bare shape in ``obstacles=[...]`` means ``Avoid(shape)``: the whole body, a margin of 5 cm.

    Example:
        >>> Avoid(Sphere(center=(0, 1.7, 2), radius=0.3), joints=["head"], margin=0.1)
        >>> Avoid(Sphere(center=[[2, 1, 2], [-2, 1, 2]], radius=0.4), frames=[0, 60])  # rolls past

    Attributes:
        shape: Sphere, Capsule, Box, Plane, HalfSpace or HeightField, in metres, Y up, in the world of the
            controls. Each of its fields may have a row for each frame (or for each of ``frames``).
        joints: Names or indices of the joints that avoid it; ``None``: all of them and the bones between.
        frames: (N,) frames at which the rows of moving fields hold; between them the shape moves evenly.
        margin: Metres that editing keeps away from the surface. Not counted as penetration.
        joint_radius: Metres; each joint is a ball of this radius. Counted as penetration.
    """

    shape: Obstacle
    joints: tuple[str | int, ...] | None
    frames: Int[Tensor, " N"] | None
    margin: float
    joint_radius: float

    def __init__(
        self,
        shape: Obstacle,
        *,
        joints: Sequence[str | int] | None = None,
        frames: Iterable[int] | None = None,
        margin: float = MARGIN,
        joint_radius: float = 0.0,
    ) -> None:
        """Make an obstacle; see the class.

        Raises:
            TypeError: If ``shape`` is no obstacle shape or ``joints`` no sequence.
            ValueError: If a joint is unknown, a length is negative, or ``frames`` do not rise or do not fit
                the rows of the shape's moving fields.
        """
        if not isinstance(shape, Obstacle):
            raise TypeError(
                f"`shape` must be a Sphere, Capsule, Box, Plane, HalfSpace or HeightField, "
                f"got {type(shape).__name__}."
            )
        _check_lengths(margin=margin, joint_radius=joint_radius)
        numbers = None if frames is None else parse_frames(frames)
        _check_movement(shape, numbers)
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "joints", None if joints is None else _checked_joints(joints))
        object.__setattr__(self, "frames", numbers)
        object.__setattr__(self, "margin", float(margin))
        object.__setattr__(self, "joint_radius", float(joint_radius))

    @property
    def label(self) -> str:
        """What messages call it, such as ``sphere``."""
        return shape_name(self.shape)

    @property
    def is_moving(self) -> bool:
        """Whether the shape changes over time."""
        return bool(moving_fields(self.shape))

    def joint_indices(self, skeleton: Skeleton) -> tuple[int, ...] | None:
        """The joints that avoid it; ``None``: the whole body.

        Raises:
            ValueError: If the skeleton lacks one of them.
        """
        if self.joints is None:
            return None
        return tuple(sorted({resolve_joint(joint, skeleton) for joint in self.joints}))

    def over(self, num_frames: int) -> Obstacle:
        """The shape in a clip of ``num_frames`` frames: still, or with a row for each of them.

        Raises:
            ValueError: If it moves over another number of frames and no ``frames`` say when.
        """
        moving = moving_fields(self.shape)
        rows = {len(value) for value in moving.values()}
        if moving and self.frames is None and rows != {num_frames}:
            raise ValueError(
                f"The {self.label} moves over {rows.pop()} frames, but the clip has {num_frames}. Give one "
                "row for each frame, or say with `frames` when the rows hold."
            )
        if self.frames is not None and int(self.frames[-1]) >= num_frames:
            raise ValueError(
                f"The {self.label} names frame {int(self.frames[-1])}, but the clip has {num_frames} frames "
                f"(0..{num_frames - 1})."
            )
        return spread(self.shape, self.frames, num_frames)

    def moved(self, offset: Tensor) -> Avoid:
        """The same obstacle with its shape moved by ``offset`` (3,) metres."""
        shape = placed(self.shape, offset=offset)
        return Avoid(
            shape, joints=self.joints, frames=self.frames, margin=self.margin, joint_radius=self.joint_radius
        )


def as_avoids(obstacles: Sequence[Obstacle | Avoid]) -> tuple[Avoid, ...]:
    """``obstacles`` with bare shapes wrapped.

    Raises:
        TypeError: If an entry is no obstacle.
    """
    if not isinstance(obstacles, Sequence) or isinstance(obstacles, str):
        raise TypeError(f"`obstacles` must be a list of obstacles, got {type(obstacles).__name__}.")
    for index, item in enumerate(obstacles):
        if not isinstance(item, Obstacle | Avoid):
            raise TypeError(
                f"`obstacles[{index}]` must be a shape such as Sphere, or an Avoid, "
                f"got {type(item).__name__}."
            )
    return tuple(item if isinstance(item, Avoid) else Avoid(item) for item in obstacles)


def _check_lengths(**lengths: float) -> None:
    for name, value in lengths.items():
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        if not is_number or not (math.isfinite(value) and value >= 0):
            raise ValueError(f"`{name}` must be a finite number of at least 0 m, got {value!r}.")


def _checked_joints(joints: Sequence[str | int]) -> tuple[str | int, ...]:
    if isinstance(joints, (str, int)):
        raise TypeError(f"`joints` must be a sequence of joints, got {joints!r}. Pass [{joints!r}].")
    names = tuple(check_joint(joint) for joint in joints)
    if not names:
        raise ValueError(
            "`joints` is empty. Name at least one joint, or pass None: the whole body avoids it."
        )
    return names


def _check_movement(shape: Obstacle, frames: Tensor | None) -> None:
    moving = moving_fields(shape)
    if frames is None:
        return
    if not moving:
        raise ValueError(
            f"`frames` is for moving obstacles, but no field of the {shape_name(shape)} has rows. "
            "Give one center (or point, radius, ...) for each frame."
        )
    if bool((torch.diff(frames) <= 0).any()):
        raise ValueError(f"`frames` must rise, got {frames.tolist()}.")
    name, value = next(iter(moving.items()))
    if len(value) != len(frames):
        raise ValueError(
            f"`{name}` must have one row for each of the {len(frames)} `frames`, got {len(value)} rows."
        )
