"""What every control boils down to: points at frames of some joints, each axis held or free."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.motion.skeleton import Skeleton


@dataclass(frozen=True, eq=False)
class ControlSamples:
    """Targets of one control in one clip: ``N`` frames of ``P`` joints.

    Attributes:
        frames: (N,) frame numbers; they may lie outside the clip.
        joints: (P,) joint indices.
        positions: (N, P, 3) metres, Y up; 0 where free.
        mask: (N, P, 3) true where the coordinate is held.
    """

    frames: Int[Tensor, " N"]
    joints: Int[Tensor, " P"]
    positions: Float[Tensor, "N P 3"]
    mask: Bool[Tensor, "N P 3"]


@runtime_checkable
class Control(Protocol):
    """A spatial control of a clip."""

    @property
    def label(self) -> str:
        """What messages call the control, such as the joint's name."""

    def sample(self, num_frames: int, skeleton: Skeleton) -> ControlSamples:
        """The targets in a clip of ``num_frames`` frames.

        Raises:
            ValueError: If the skeleton lacks a joint of the control.
        """
