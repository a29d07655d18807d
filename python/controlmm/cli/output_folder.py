"""The place that ``--out`` names, looked at before the work whose result goes there."""

from __future__ import annotations

import os
from pathlib import Path


def writable_folder(out: Path) -> Path:
    """``out``, if it is a folder or can be made one; makes nothing.

    Raises:
        NotADirectoryError: If a file stands where a folder must be.
        PermissionError: If nothing may be written there.
    """
    place = out.absolute()
    there = next(parent for parent in (place, *place.parents) if parent.exists())
    if not there.is_dir():
        raise NotADirectoryError(f"`--out` needs a folder, but {there} is a file. Choose another place.")
    if not os.access(there, os.W_OK | os.X_OK):
        raise PermissionError(f"`--out`: nothing may be written in {there}. Choose another place.")
    return out


def writable_file(out: Path) -> Path:
    """``out``, if a file of that name can be written; makes nothing.

    Raises:
        NotADirectoryError, PermissionError: As :func:`writable_folder`, of the folder that it is in.
    """
    writable_folder(out.parent)
    return out
