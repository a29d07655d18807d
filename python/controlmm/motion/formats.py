"""Finds the reader and writer of a motion file by its suffix, among the `controlmm.formats` plugins."""

from __future__ import annotations

from functools import lru_cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

FORMATS_GROUP = "controlmm.formats"


class MotionFormat(Protocol):
    """One file format. Either method may raise ``ValueError`` to say that the direction is not supported."""

    @staticmethod
    def save(motion: Any, path: Path, **options: Any) -> None:
        """Write ``motion`` to ``path``."""

    @staticmethod
    def load(path: Path, **options: Any) -> Any:
        """Read a motion from ``path``."""


def known_suffixes() -> tuple[str, ...]:
    """The suffixes that can be saved or loaded, without the dot, sorted."""
    return tuple(sorted({entry.name for entry in entry_points(group=FORMATS_GROUP)}))


@lru_cache
def _load_format(suffix: str) -> MotionFormat:
    found = entry_points(group=FORMATS_GROUP, name=suffix)
    if not found:
        raise ValueError(
            f"Unknown motion format {'.' + suffix!r}. Use one of: {', '.join(known_suffixes())}."
        )
    plugin: MotionFormat = next(iter(found)).load()
    return plugin


def format_for(path: Path) -> MotionFormat:
    """The format plugin for ``path``, chosen by its suffix.

    Raises:
        ValueError: If no plugin has that suffix.
    """
    return _load_format(path.suffix.lower().lstrip("."))
