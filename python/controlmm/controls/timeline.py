"""Entries of a timeline: what a body part does, and when."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral, Real

from controlmm.controls.document import FPS
from controlmm.controls.parts import check_part

MIN_ENTRY_FRAMES = 8


@dataclass(frozen=True, init=False)
class TimelineEntry:
    """A body part follows a prompt from ``start`` to ``end``.

    Example:
        >>> TimelineEntry("lower", "a person jumps forward", seconds=(3.0, 6.0))
        >>> TimelineEntry("upper", "a person puts the hands in the air", frames=(0, 120))

    Attributes:
        part: ``lower``, ``upper``, ``left_arm``, ..., ``body`` (see ``controlmm.controls.PARTS``) or a joint.
        prompt: What the person does.
        start: First frame, at 20 fps.
        end: Frame after the last.
    """

    part: str
    prompt: str
    start: int
    end: int

    def __init__(
        self,
        part: str,
        prompt: str,
        *,
        seconds: tuple[float, float] | None = None,
        frames: tuple[int, int] | None = None,
    ) -> None:
        """Make an entry; see the class.

        Args:
            part: The part or joint that the prompt is for.
            prompt: What the person does.
            seconds: Start and end; or pass ``frames``.
            frames: First frame and the frame after the last.

        Raises:
            TypeError: If ``part`` or ``prompt`` is no string.
            ValueError: If the part is unknown, the prompt is empty, both or neither of ``seconds`` and
                ``frames`` are given, or the interval is shorter than 8 frames or begins before 0.
        """
        if not isinstance(prompt, str):
            raise TypeError(f"`prompt` must be a string, got {type(prompt).__name__}.")
        if not prompt.strip():
            raise ValueError("`prompt` is empty. Say what the person does.")
        if (seconds is None) == (frames is None):
            raise ValueError(f"Pass `seconds` or `frames`, one of them (got {seconds} and {frames}).")
        start, end = _frame_pair(frames) if seconds is None else _second_pair(seconds)
        if start < 0 or end - start < MIN_ENTRY_FRAMES:
            raise ValueError(
                f"An entry must begin at 0 or later and last at least {MIN_ENTRY_FRAMES} frames "
                f"({MIN_ENTRY_FRAMES / FPS} s), got frames {start} to {end}."
            )
        object.__setattr__(self, "part", check_part(part))
        object.__setattr__(self, "prompt", prompt)
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "end", end)

    @property
    def label(self) -> str:
        """Part and time, such as ``upper 0-3 s``."""
        return f"{self.part} {self.start / FPS:g}-{self.end / FPS:g} s"


def check_timeline(entries: Sequence[TimelineEntry]) -> tuple[TimelineEntry, ...]:
    """The entries, in their order.

    Raises:
        TypeError: If it is no sequence of entries.
        ValueError: If there are none.
    """
    if not isinstance(entries, Sequence) or isinstance(entries, str):
        raise TypeError(f"`entries` must be a list of TimelineEntry, got {type(entries).__name__}.")
    for index, entry in enumerate(entries):
        if not isinstance(entry, TimelineEntry):
            raise TypeError(f"`entries[{index}]` must be a TimelineEntry, got {type(entry).__name__}.")
    if not entries:
        raise ValueError("`entries` is empty. Give at least one TimelineEntry.")
    return tuple(entries)


def _frame_pair(frames: tuple[int, int] | None) -> tuple[int, int]:
    is_pair = isinstance(frames, Sequence) and len(frames) == 2
    if not is_pair or any(isinstance(f, bool) or not isinstance(f, Integral) for f in frames or ()):
        raise ValueError(f"`frames` must be two whole numbers, start and end, got {frames!r}.")
    start, end = frames  # type: ignore[misc]
    return int(start), int(end)


def _second_pair(seconds: tuple[float, float]) -> tuple[int, int]:
    is_pair = isinstance(seconds, Sequence) and len(seconds) == 2
    if not is_pair or any(
        isinstance(s, bool) or not isinstance(s, Real) or not math.isfinite(s) for s in seconds
    ):
        raise ValueError(f"`seconds` must be two numbers, start and end, got {seconds!r}.")
    return round(seconds[0] * FPS), round(seconds[1] * FPS)
