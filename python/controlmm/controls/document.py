"""What a control file holds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from controlmm.controls.samples import Control

FPS = 20
HEADER: dict[str, Any] = {"version": 1, "units": "m", "up": "y", "fps": FPS}


@dataclass(frozen=True, eq=False)
class ControlFile:
    """Controls, with the prompt and the length that go with them if the file says so.

    Attributes:
        controls: The controls, in the order of the file.
        seconds: Length of the clip in seconds, or ``None``.
        text: The prompt, or ``None``.
    """

    controls: Sequence[Control]
    seconds: float | None = None
    text: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "controls", tuple(self.controls))
        if self.seconds is not None and not (math.isfinite(self.seconds) and self.seconds > 0):
            raise ValueError(f"`seconds` must be positive and finite, got {self.seconds}.")
