"""What a control file holds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from controlmm.controls.avoid import Avoid, as_avoids
from controlmm.controls.samples import Control
from controlmm.ops import Obstacle

if TYPE_CHECKING:
    from controlmm.controls.timeline import TimelineEntry

FPS = 20
HEADER: dict[str, Any] = {"version": 1, "units": "m", "up": "y", "fps": FPS}


@dataclass(frozen=True, eq=False)
class ControlFile:
    """Controls, obstacles and a timeline, with the prompt and the length if the file says so.

    Attributes:
        controls: The controls, in the order of the file.
        seconds: Length of the clip in seconds, or ``None``.
        text: The prompt, or ``None``.
        obstacles: What joints keep out of; bare shapes become :class:`Avoid`.
        timeline: Entries of what each body part does when, in their order.
    """

    controls: Sequence[Control] = ()
    seconds: float | None = None
    text: str | None = None
    obstacles: Sequence[Obstacle | Avoid] = ()
    timeline: Sequence[TimelineEntry] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "controls", tuple(self.controls))
        object.__setattr__(self, "obstacles", as_avoids(self.obstacles))
        object.__setattr__(self, "timeline", tuple(self.timeline))
        if self.seconds is not None and not (math.isfinite(self.seconds) and self.seconds > 0):
            raise ValueError(f"`seconds` must be positive and finite, got {self.seconds}.")
