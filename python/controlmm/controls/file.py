"""Reads and writes control files: JSON, CSV tables, NumPy arrays."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from controlmm.controls.arrays import parse_npy, parse_npz
from controlmm.controls.document import ControlFile
from controlmm.controls.json_reader import parse_json
from controlmm.controls.json_writer import format_json
from controlmm.controls.table import parse_csv

_READERS: dict[str, Callable[[bytes], ControlFile]] = {
    ".json": parse_json,
    ".csv": parse_csv,
    ".npy": parse_npy,
    ".npz": parse_npz,
}

__all__ = ["ControlFile", "load_controls", "save_controls"]


def load_controls(path: str | Path) -> ControlFile:
    """The controls in a file, chosen by its suffix.

    - ``.json``: controlmm's own form, with all kinds of controls.
    - ``.csv``: a table with the columns ``frame,joint,x,y,z``; an empty x, y or z leaves that axis free.
    - ``.npy``, ``.npz``: one array (T, 22, 3), NaN where nothing is controlled; in an ``.npz`` it is named
      ``positions`` or ``joints``, or it is the only one. ``seconds`` is then T / 20.

    Frames are counted from 0 at 20 fps; positions are global, in metres, Y up.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the suffix is unknown or the file is wrong; the message names the file and the place.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path}: a control file must end in {', '.join(_READERS)}, got {path.suffix!r}.")
    if not path.is_file():
        raise FileNotFoundError(f"No control file at {path}.")
    try:
        return reader(path.read_bytes())
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from error  # NumPy writes several lines


def save_controls(file: ControlFile, path: str | Path) -> Path:
    """Write a control file as JSON; missing parent folders are made. Returns the path.

    Raises:
        ValueError: If ``path`` does not end in ``.json``.
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        raise ValueError(f"{path}: controls are written as .json, got {path.suffix!r}.")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(format_json(file), encoding="utf-8", newline="\n")
    return path
