"""Checks of the values in a control document; every error says where in the document it is."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Collection
from typing import Any


class PlacedError(ValueError):
    """A ``ValueError`` whose message begins with the place in the document."""

    def __init__(self, where: str, problem: str) -> None:
        super().__init__(f"{where}: {problem}" if where else problem)


def check_keys(value: Any, where: str, *, required: Collection[str], optional: Collection[str]) -> None:
    """Refuse an object with unknown or missing keys (or something that is no object)."""
    check_type(value, where, dict, "an object")
    known = sorted({*required, *optional})
    for key in value:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            suggestion = f' Did you mean "{near[0]}"?' if near else ""
            raise PlacedError(where, f'unknown key "{key}".{suggestion} Known keys: {", ".join(known)}.')
    for key in required:
        if key not in value:
            raise PlacedError(where, f'missing key "{key}". Needed keys: {", ".join(required)}.')


def check_constant(value: Any, where: str, expected: float | str) -> None:
    """Refuse another value than ``expected``."""
    if isinstance(value, bool) or value != expected:
        raise PlacedError(where, f"must be {shown(expected)}, got {shown(value)}.")


def check_type(value: Any, where: str, kind: type, words: str) -> None:
    """Refuse a value of another type than ``kind``."""
    if not isinstance(value, kind):
        raise PlacedError(where, f"must be {words}, got {shown(value)}.")


def check_number(value: Any, where: str) -> None:
    """Refuse what is not a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise PlacedError(where, f"must be a number, got {shown(value)}.")
    if not math.isfinite(value):
        raise PlacedError(where, f"must be a finite number, got {shown(value)}.")


def check_joint(value: Any, where: str) -> None:
    """Refuse what is neither a name nor an index; whether the joint exists is checked by the control."""
    if isinstance(value, bool) or not isinstance(value, (str, int)):
        raise PlacedError(where, f"must be a joint's name or index, got {shown(value)}.")


def check_frames(value: Any, where: str) -> None:
    """Refuse what is not a list of whole numbers."""
    check_type(value, where, list, "a list of frame numbers")
    for index, frame in enumerate(value):
        if isinstance(frame, bool) or not isinstance(frame, int):
            raise PlacedError(f"{where}[{index}]", f"must be a whole number, got {shown(frame)}.")


def check_points(value: Any, where: str, *, depth: int, width: int) -> None:
    """Refuse what is not lists, ``depth`` deep, of ``width`` finite numbers (or null for a free axis)."""
    if depth == 0:
        if value is not None:
            check_number(value, where)
        return
    words = (
        f"a list of {width} numbers"
        if depth == 1
        else "a list of points"
        if depth == 2
        else "a list of poses"
    )
    check_type(value, where, list, words)
    if depth == 1 and len(value) != width:
        raise PlacedError(where, f"must be a list of {width} numbers, got {len(value)}: {shown(value)}.")
    for index, item in enumerate(value):
        # A number inside a point is named by its point: `positions[3]` reads better than `positions[3][1]`.
        check_points(item, where if depth == 1 else f"{where}[{index}]", depth=depth - 1, width=width)


def shown(value: Any) -> str:
    """The value as JSON, shortened."""
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 40 else f"{text[:37]}..."
