"""Results of a long benchmark, one JSON line each, so that a killed run goes on where it was."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from tqdm import tqdm

Row = dict[str, Any]


def measured_rows(path: Path, keys: Iterable[str], measure: Callable[[str], Row]) -> list[Row]:
    """One row a key, in the order of the keys; those in the file are taken from there.

    Args:
        path: A ``.jsonl`` file; made if it is not there, and written after every row.
        keys: What there is to measure.
        measure: Makes the row of a key.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = known_rows(path)
    with path.open("a") as file:
        for key in tqdm(list(keys), desc=path.parent.name, unit="row"):
            if key in rows:
                continue
            rows[key] = {"key": key, **measure(key)}
            file.write(json.dumps(rows[key]) + "\n")
            file.flush()
    return [rows[key] for key in keys]


def known_rows(path: Path) -> dict[str, Row]:
    """The rows of a file by their keys; the line that a kill cut off is none."""
    rows: dict[str, Row] = {}
    for line in path.read_text().splitlines() if path.is_file() else ():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        rows[row["key"]] = row
    return rows
