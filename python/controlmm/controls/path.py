"""Control of a joint's way over the ground."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from controlmm.controls.checks import check_finite, check_joint, parse_frames, parse_points, resolve_joint
from controlmm.controls.samples import ControlSamples
from controlmm.motion.skeleton import Skeleton

_HELD_AXES = (True, False, True)  # x and z; the height is free


@dataclass(frozen=True, eq=False, init=False)
class PathControl:
    """Leads a joint along a curve on the ground and leaves its height free.

    Example:
        >>> PathControl("pelvis", xz=[[0, 0], [0, 2], [1, 4]])  # over the whole clip, at constant speed
        >>> PathControl("pelvis", xz=[[0, 0], [0, 2]], frames=[0, 60])  # only these two frames are held

    Attributes:
        joint: Name or index.
        xz: (N, 2) ground points in metres, float32; the body starts at the origin, faces +Z, left is +X.
        frames: (N,) frame of each point, or ``None``: the curve is spread evenly over the whole clip.
    """

    joint: str | int
    xz: Float[Tensor, "N 2"]
    frames: Int[Tensor, " N"] | None

    def __init__(self, joint: str | int = "pelvis", *, xz: Any, frames: Iterable[int] | None = None) -> None:
        """Make a control.

        Args:
            joint: Name or index of the joint.
            xz: (N, 2) array, tensor or nested list: x and z of each point in metres.
            frames: N different frame numbers, or ``None`` to follow the curve over the whole clip at constant
                speed.

        Raises:
            TypeError: If ``joint`` or ``frames`` has the wrong type.
            ValueError: If the joint is unknown, a frame is bad, or ``xz`` has another shape, NaN or infinity.
        """
        numbers = None if frames is None else parse_frames(frames)
        points, mask = parse_points(xz, name="xz")
        _check_shape(points, numbers)
        if not mask.all():
            raise ValueError("`xz` must not hold None. To hold only x or only z use a JointControl.")
        check_finite(points, name="xz", frames=numbers)
        object.__setattr__(self, "joint", check_joint(joint))
        object.__setattr__(self, "xz", points)
        object.__setattr__(self, "frames", numbers)

    @property
    def label(self) -> str:
        """The joint's name and ``path``."""
        return f"{self.joint} path" if isinstance(self.joint, str) else f"joint {self.joint} path"

    @property
    def length(self) -> float:
        """Length of the curve in metres."""
        return float(_arc_lengths(self.xz.double().numpy())[-1])

    def sample(self, num_frames: int, skeleton: Skeleton) -> ControlSamples:
        """The targets, see :class:`~controlmm.controls.samples.Control`."""
        joints = torch.tensor([resolve_joint(self.joint, skeleton)])
        if self.frames is None:
            frames, points = torch.arange(num_frames), _spread_evenly(self.xz, num_frames)
        else:
            frames, points = self.frames, self.xz
        positions = torch.zeros(len(frames), 1, 3)
        positions[:, 0, 0], positions[:, 0, 2] = points[:, 0], points[:, 1]
        return ControlSamples(frames, joints, positions, torch.tensor(_HELD_AXES).expand(len(frames), 1, 3))


def _check_shape(points: Tensor, frames: Tensor | None) -> None:
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(
            f"`xz` must have shape (N, 2), got {tuple(points.shape)}. Pass x and z of each point in metres."
        )
    if frames is None and len(points) < 2:
        raise ValueError(f"`xz` needs at least 2 points without `frames`, got {len(points)}.")
    if frames is not None and len(frames) != len(points):
        raise ValueError(
            f"`xz` must hold one point for each of the {len(frames)} `frames`, got {len(points)} points."
        )


def _arc_lengths(points: np.ndarray[Any, np.dtype[np.float64]]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Way from the first point to each point along the curve, (N,) metres."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _spread_evenly(xz: Float[Tensor, "N 2"], count: int) -> Float[Tensor, "M 2"]:
    """``count`` points on the curve at equal distances along it, ends included."""
    points = xz.double().numpy()
    way = _arc_lengths(points)
    wanted = np.linspace(0.0, way[-1], count)
    columns = [np.interp(wanted, way, points[:, axis]) for axis in range(2)]
    return torch.from_numpy(np.stack(columns, axis=1).astype(np.float32))
