"""The JSON form of timelines: read and written beside the controls."""

from __future__ import annotations

from typing import Any

from controlmm.controls.document import FPS
from controlmm.controls.json_values import PlacedError, check_keys, check_number, check_type
from controlmm.controls.timeline import TimelineEntry


def parse_entry(item: Any, where: str) -> TimelineEntry:
    """One entry of ``timeline``; ``start`` and ``end`` are seconds.

    Raises:
        ValueError: If it is broken; the message begins with the place.
    """
    check_keys(item, where, required=("part", "prompt", "start", "end"), optional=())
    for name in ("part", "prompt"):
        check_type(item[name], f"{where}.{name}", str, "a string")
    for name in ("start", "end"):
        check_number(item[name], f"{where}.{name}")
    try:
        return TimelineEntry(item["part"], item["prompt"], seconds=(item["start"], item["end"]))
    except ValueError as error:
        raise PlacedError(where, str(error)) from error


def entry_as_dict(entry: TimelineEntry) -> dict[str, Any]:
    """The JSON object of an entry."""
    return {
        "part": entry.part,
        "prompt": entry.prompt,
        "start": entry.start / FPS,
        "end": entry.end / FPS,
    }
