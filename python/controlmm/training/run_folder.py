"""The folder of a training run: what it was told, its log, a checkpoint that outlives any kill."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from controlmm.io.settings_changes import settings_changes
from controlmm.training.settings import TrainingSettings

CHECKPOINT_FILE, LOG_FILE, SETTINGS_FILE = "checkpoint.safetensors", "metrics.jsonl", "run.json"
STARTS_FILE, SUMMARY_FILE = "starts.jsonl", "summary.json"
_SETTINGS = "settings"  # key of the training settings among what a run was told


class RunFolder:
    """Reads and writes one run. Files are replaced in one step, so that each is whole or old, never half."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    @property
    def checkpoint(self) -> Path:
        """The checkpoint's file."""
        return self.path / CHECKPOINT_FILE

    @property
    def has_checkpoint(self) -> bool:
        """Whether there is something to resume."""
        return self.checkpoint.is_file()

    def write_settings(self, told: dict[str, Any], files: Mapping[str, str] | None = None) -> None:
        """Store what the run was told, and texts beside it (``files``: content by name).

        A run of an older version is resumed although it lacks entries that came later; its settings had the
        values that are the defaults now.

        Raises:
            ValueError: If the folder holds a run with other settings.
        """
        file = self.path / SETTINGS_FILE
        if self.has_checkpoint and file.is_file():
            before, now = _with_default_settings(_read_json(file)), json.loads(json.dumps(told))
            changes = settings_changes(before, {key: value for key, value in now.items() if key in before})
            if changes:
                raise ValueError(
                    f"{self.path} holds a run with other settings: {changes}. "
                    "Resume it with the same ones or choose another folder."
                )
            return
        self.path.mkdir(parents=True, exist_ok=True)
        for name, text in (files or {}).items():
            _replace(self.path / name, text.encode())
        _replace(file, (json.dumps(told, indent=2) + "\n").encode())

    def write_start(self, about: dict[str, Any]) -> None:
        """Append one line about this start of the run."""
        with (self.path / STARTS_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(about) + "\n")

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Store how the run ended."""
        _replace(self.path / SUMMARY_FILE, (json.dumps(summary, indent=2) + "\n").encode())

    def log(self, record: dict[str, float]) -> None:
        """Append one line of metrics."""
        with (self.path / LOG_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps({key: _rounded(value) for key, value in record.items()}) + "\n")

    def records(self) -> list[dict[str, float]]:
        """All lines of metrics so far; a line that a kill cut short is left out."""
        file = self.path / LOG_FILE
        records = []
        for line in file.read_text(encoding="utf-8").splitlines() if file.is_file() else []:
            try:
                records.append(json.loads(line))
            except json.JSONDecodeError:
                continue
        return records

    def forget_after(self, step: int) -> None:
        """Drop log lines of steps that a resumed run will take again."""
        kept = [record for record in self.records() if record["step"] <= step]
        _replace(self.path / LOG_FILE, "".join(json.dumps(record) + "\n" for record in kept).encode())


def _with_default_settings(told: dict[str, Any]) -> dict[str, Any]:
    stored = told.get(_SETTINGS, {})
    defaults = {
        field.name: field.default
        for field in dataclasses.fields(TrainingSettings)
        if field.default is not dataclasses.MISSING
    }
    merged = json.loads(json.dumps({**defaults, **stored}))
    return {**told, _SETTINGS: merged} if stored else told


def _read_json(file: Path) -> dict[str, Any]:
    try:
        content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{file} is damaged ({error}). Restore it or choose another folder.") from error
    return content


def _replace(path: Path, content: bytes) -> None:
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_bytes(content)
    temporary.replace(path)


def _rounded(value: float) -> float:
    return value if isinstance(value, int) else float(f"{value:.6g}")
