"""Controls from a CSV table: one row for each joint and frame."""

from __future__ import annotations

import csv
import io

from controlmm.controls.document import ControlFile
from controlmm.controls.joint import JointControl

COLUMNS = ("frame", "joint", "x", "y", "z")
_Row = tuple[int, list[float | None]]  # frame, point


def parse_csv(content: bytes) -> ControlFile:
    """One joint control for each joint of the table; an empty x, y or z leaves that axis free.

    Raises:
        ValueError: If the table is wrong; the message names the line.
    """
    try:
        reader = csv.DictReader(io.StringIO(content.decode("utf-8-sig"), newline=""), skipinitialspace=True)
        names = [name.strip().lower() for name in reader.fieldnames or ()]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"not a CSV table in UTF-8 ({error}).") from error
    if sorted(names) != sorted(COLUMNS):
        cure = " Separate them by commas." if any(";" in name or "\t" in name for name in names) else ""
        raise ValueError(
            f"line 1: the columns must be {','.join(COLUMNS)}, got {','.join(names) or 'nothing'}.{cure}"
        )
    reader.fieldnames = names
    rows: dict[str | int, list[_Row]] = {}
    for cells in reader:
        joint, row = _parse_row(cells, reader.line_num)
        rows.setdefault(joint, []).append(row)
    if not rows:
        raise ValueError("the table has no rows, so it controls nothing.")
    return ControlFile([_joint_control(joint, of_joint) for joint, of_joint in rows.items()])


def _parse_row(cells: dict[str | None, str | None], line: int) -> tuple[str | int, _Row]:
    if None in cells or None in cells.values():
        named = [text for name, text in cells.items() if name is not None and text is not None]
        count = len(named) + len(cells.get(None) or ())
        raise ValueError(f"line {line}: expected {len(COLUMNS)} values ({','.join(COLUMNS)}), got {count}.")
    texts = {name: (text or "").strip() for name, text in cells.items()}
    if not texts["frame"].isdecimal():
        raise ValueError(f"line {line}: `frame` must be a whole number from 0, got {texts['frame']!r}.")
    if not texts["joint"]:
        raise ValueError(f"line {line}: `joint` is empty. Name a joint, such as pelvis.")
    joint = int(texts["joint"]) if texts["joint"].isdecimal() else texts["joint"]
    return joint, (int(texts["frame"]), [_parse_number(texts[axis], axis, line) for axis in "xyz"])


def _parse_number(text: str, axis: str, line: int) -> float | None:
    if not text:
        return None
    try:
        return float(text)
    except ValueError:
        raise ValueError(
            f"line {line}: `{axis}` must be a number in metres or empty, got {text!r}."
        ) from None


def _joint_control(joint: str | int, rows: list[_Row]) -> JointControl:
    try:
        return JointControl(
            joint, frames=[frame for frame, _ in rows], positions=[point for _, point in rows]
        )
    except ValueError as error:
        raise ValueError(f"joint {joint}: {error}") from error
