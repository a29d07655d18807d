"""Control of one joint at chosen frames."""

from __future__ import annotations

from collections.abc import Iterable
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
from controlmm.motion.skeleton import Skeleton


@dataclass(frozen=True, eq=False, init=False)
class JointControl:
    """Holds one joint at given points at given frames.

    Example:
        >>> JointControl("right_wrist", frames=[0, 40], positions=[[-0.3, 1.0, 0.2], [-0.3, 1.5, 0.4]])
        >>> JointControl("pelvis", frames=[60], positions=[[1.0, None, 2.0]])  # height left free

    Attributes:
        joint: Name or index.
        frames: (N,) frame numbers from 0, at 20 fps.
        positions: (N, 3) global position in metres, Y up, float32; 0 where an axis is free. The body starts
            at the origin and faces +Z, its left is +X.
        mask: (N, 3) true where the axis is held.
    """

    joint: str | int
    frames: Int[Tensor, " N"]
    positions: Float[Tensor, "N 3"]
    mask: Bool[Tensor, "N 3"]

    def __init__(self, joint: str | int, frames: Iterable[int], positions: Any) -> None:
        """Make a control.

        Args:
            joint: Name (``"right_wrist"``) or index of the joint.
            frames: N different frame numbers, not negative, in any order.
            positions: (N, 3) array, tensor or nested list in metres; ``None`` leaves that axis free.

        Raises:
            TypeError: If ``joint`` or ``frames`` has the wrong type.
            ValueError: If the joint is unknown, a frame is bad, or ``positions`` has another shape or is not
                finite.
        """
        numbers = parse_frames(frames)
        points, mask = parse_points(positions, name="positions")
        if tuple(points.shape) != (len(numbers), 3):
            raise ValueError(
                f"`positions` must have shape (len(frames), 3) = ({len(numbers)}, 3), "
                f"got {tuple(points.shape)}. Pass one 3D point in metres for each controlled frame."
            )
        check_finite(points, name="positions", frames=numbers)
        check_some_axis(mask, numbers)
        object.__setattr__(self, "joint", check_joint(joint))
        object.__setattr__(self, "frames", numbers)
        object.__setattr__(self, "positions", points)
        object.__setattr__(self, "mask", mask)

    @property
    def label(self) -> str:
        """The joint's name, or ``joint 5`` for an index."""
        return self.joint if isinstance(self.joint, str) else f"joint {self.joint}"

    def sample(self, num_frames: int, skeleton: Skeleton) -> ControlSamples:  # noqa: ARG002 - same for every length
        """The targets, see :class:`~controlmm.controls.samples.Control`."""
        joints = torch.tensor([resolve_joint(self.joint, skeleton)])
        return ControlSamples(self.frames, joints, self.positions[:, None], self.mask[:, None])
