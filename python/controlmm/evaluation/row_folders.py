"""Where the batches of a row are kept, and what says that they are its."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from controlmm.io.atomic import replaced_on_success
from controlmm.io.settings_changes import settings_changes

ROW_FILE = "row.json"
_HASH_DIGITS = 24


def labelled_folders(labels: Sequence[str], abouts: Sequence[Mapping[str, Any]], root: Path) -> list[Path]:
    """A folder named by the label for each row; one that holds another evaluation is refused.

    Raises:
        ValueError: If two labels are alike, or a folder holds another evaluation.
    """
    names = ["".join(c if c.isalnum() else "-" for c in label.lower()).strip("-") for label in labels]
    if len(set(names)) < len(names):
        raise ValueError(f"Rows must have different labels, got {', '.join(labels)}.")
    folders = [root / name for name in names]
    for folder, label, about in zip(folders, labels, abouts, strict=True):
        _claim(folder, {"label": label, **about})
    return folders


def shared_folders(abouts: Sequence[Mapping[str, Any]], root: Path) -> list[Path]:
    """A folder named by what it holds for each row: rows of several tables that are the same share one."""
    folders = [root / hashlib.sha256(_text(about).encode()).hexdigest()[:_HASH_DIGITS] for about in abouts]
    for folder, about in zip(folders, abouts, strict=True):
        _claim(folder, about)
    return folders


def _claim(folder: Path, about: Mapping[str, Any]) -> None:
    """Write down what the folder holds, or check that it holds just that."""
    file = folder / ROW_FILE
    text = _text(about)
    if file.is_file():
        try:
            before = json.loads(file.read_text(encoding="utf-8"))
        except json.JSONDecodeError:
            before = {}
        changes = settings_changes(before, json.loads(text))
        if changes:
            raise ValueError(
                f"{folder} holds an evaluation with other settings: {changes}. Go on with the same ones or "
                "choose another `--out`."
            )
        return
    folder.mkdir(parents=True, exist_ok=True)
    with replaced_on_success(file) as partial:
        partial.write_text(text, encoding="utf-8")


def _text(about: Mapping[str, Any]) -> str:
    return json.dumps(about, indent=2, sort_keys=True) + "\n"
