"""Control of a whole pose, or of several joints of it, at key frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.controls.checks import (
    check_finite,
    check_joint,
    check_some_axis,
    parse_frames,
    parse_points,
    resolve_joint,
)
from controlmm.controls.samples import ControlSamples
from controlmm.motion.skeleton import SKELETONS, Skeleton, skeleton_of_joints

_BODY_SIZES = tuple(skeleton.num_joints for skeleton in SKELETONS.values())


@dataclass(frozen=True, eq=False, init=False)
class PoseControl:
    """Holds all joints, or the ones named, at key frames.

    Example:
        >>> PoseControl(frames=[0, 119], positions=motion.joints[[0, -1]])
        >>> PoseControl(frames=[40], positions=motion.joints[[40]], joints=["left_wrist", "right_wrist"])

    Attributes:
        frames: (N,) frame numbers from 0, at 20 fps.
        positions: (N, P, 3) global positions of the held joints in metres, Y up, float32; 0 where an axis is
            free.
        joints: The ``P`` held joints, or ``None``: all joints of the skeleton in its order.
        mask: (N, P, 3) true where the axis is held.
    """

    frames: Int[Tensor, " N"]
    positions: Float[Tensor, "N P 3"]
    joints: tuple[str | int, ...] | None
    mask: Bool[Tensor, "N P 3"]

    def __init__(
        self, frames: Iterable[int], positions: Any, joints: Sequence[str | int] | None = None
    ) -> None:
        """Make a control.

        Args:
            frames: N different frame numbers, not negative, in any order.
            positions: (N, J, 3) whole poses in metres, or (N, P, 3) with only the joints named in ``joints``.
                ``None`` in a nested list leaves that axis free.
            joints: Names or indices of the P joints to hold; ``None`` holds all.

        Raises:
            TypeError: If ``joints`` or ``frames`` has the wrong type.
            ValueError: If a joint is unknown or named twice, a frame is bad, or ``positions`` has another
                shape or is not finite.
        """
        numbers = parse_frames(frames)
        names = None if joints is None else _check_joints(joints)
        points, mask = parse_points(positions, name="positions")
        _check_shape(points, numbers, names)
        if names is not None and points.shape[1] != len(names):
            body = skeleton_of_joints(points.shape[1])
            chosen = [resolve_joint(name, body) for name in names]
            points, mask = points[:, chosen], mask[:, chosen]
        check_finite(points, name="positions", frames=numbers)
        check_some_axis(mask, numbers)
        object.__setattr__(self, "frames", numbers)
        object.__setattr__(self, "positions", points)
        object.__setattr__(self, "joints", names)
        object.__setattr__(self, "mask", mask)

    @property
    def label(self) -> str:
        """``pose``, with the joints if only some are held."""
        return "pose" if self.joints is None else f"pose of {', '.join(map(str, self.joints))}"

    def sample(self, num_frames: int, skeleton: Skeleton) -> ControlSamples:  # noqa: ARG002 - same for every length
        """The targets, see :class:`~controlmm.controls.samples.Control`."""
        if self.joints is None and self.positions.shape[1] != skeleton.num_joints:
            raise ValueError(
                f"The pose has {self.positions.shape[1]} joints, but the {skeleton.name} skeleton has "
                f"{skeleton.num_joints}. Name the joints with `joints`."
            )
        names = range(skeleton.num_joints) if self.joints is None else self.joints
        indices = [resolve_joint(name, skeleton) for name in names]
        _refuse_doubles(indices, skeleton)
        return ControlSamples(self.frames, torch.tensor(indices), self.positions, self.mask)


def _check_joints(joints: Sequence[str | int]) -> tuple[str | int, ...]:
    if isinstance(joints, (str, int)):
        raise TypeError(f"`joints` must be a sequence of joints, got {joints!r}. Pass [{joints!r}].")
    names = tuple(check_joint(joint) for joint in joints)
    if not names:
        raise ValueError("`joints` is empty. Name at least one joint, or pass None to hold all.")
    for position, name in enumerate(names):
        if name in names[:position]:
            raise ValueError(f"`joints` names {name!r} twice.")
    return names


def _check_shape(points: Tensor, frames: Tensor, names: tuple[str | int, ...] | None) -> None:
    widths = _BODY_SIZES if names is None else (*_BODY_SIZES, len(names))
    if points.ndim == 3 and len(points) == len(frames) and points.shape[1] in widths and points.shape[2] == 3:
        return
    count = "22" if names is None else f"22 or len(joints) = {len(names)}"
    raise ValueError(
        f"`positions` must have shape (len(frames), {count}, 3) with len(frames) = {len(frames)}, "
        f"got {tuple(points.shape)}. Pass one pose in metres for each key frame."
    )


def _refuse_doubles(indices: list[int], skeleton: Skeleton) -> None:
    """A name and an index may mean the same joint; that shows only once the skeleton is known."""
    for position, index in enumerate(indices):
        if index in indices[:position]:
            raise ValueError(f"`joints` names {skeleton.joint_names[index]} twice.")
