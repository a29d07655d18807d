"""The papers' tables as they were printed.

Sources: Pinyoanuntapong et al., ControlMM (later MaskControl, ICCV 2025), arXiv 2410.10780; Wan et al.,
TLControl, ECCV 2024 (names that begin with ``tl-``). Numbers only; known contradictions between a paper's
text and its tables are resolved for the tables.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

_FILE = ("published", "tables.json")


@dataclass(frozen=True)
class PublishedTable:
    """A table of a paper: titles of its columns and its rows, as text."""

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def published_table(name: str) -> PublishedTable:
    """The table ``name``, such as ``table4`` or ``tl-table1``.

    Raises:
        ValueError: If there is none; the message lists them.
    """
    tables = _all_tables()
    if name not in tables:
        raise ValueError(f"Unknown table {name!r}. Tables: {', '.join(tables)}.")
    found = tables[name]
    return PublishedTable(name, found["title"], tuple(found["columns"]), tuple(map(tuple, found["rows"])))


def published_names() -> tuple[str, ...]:
    """Names of all tables, in the order of the papers."""
    return tuple(_all_tables())


@cache
def _all_tables() -> dict[str, Any]:
    text = files("controlmm.evaluation").joinpath(*_FILE).read_text(encoding="utf-8")
    tables: dict[str, Any] = json.loads(text)
    return tables
