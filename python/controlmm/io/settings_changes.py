"""What differs between the settings that a folder was begun with and those of now."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

_LONGEST_VALUE = 24  # characters; longer ones, such as hashes, say nothing to a reader


def settings_changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """The entries that differ, as in ``"settings.seed (3407 before, 9 now), data"``; empty if none does.

    Args:
        before: What the folder holds: values of JSON by their names, nested; ``None`` is as good as absent.
        now: The same of this call.
    """
    return ", ".join(_changes(before, now, ""))


def _changes(before: Mapping[str, Any], now: Mapping[str, Any], place: str) -> Iterator[str]:
    for name in sorted(before.keys() | now.keys()):
        old, new = before.get(name), now.get(name)
        if old == new:
            continue
        if isinstance(old, dict) and isinstance(new, dict):
            yield from _changes(old, new, f"{place}{name}.")
        else:
            yield place + name + _values(old, new)


def _values(old: Any, new: Any) -> str:
    texts = ["none" if value is None else json.dumps(value) for value in (old, new)]
    return "" if max(map(len, texts)) > _LONGEST_VALUE else f" ({texts[0]} before, {texts[1]} now)"
