"""The folder of a training run: settings, log, and a checkpoint that survives a kill at any moment."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

CHECKPOINT_FILE, LOG_FILE, SETTINGS_FILE = "checkpoint.safetensors", "metrics.jsonl", "run.json"


class RunFolder:
    """Reads and writes one run. Files are replaced in one step, so that each is whole or old, never half."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    @property
    def has_checkpoint(self) -> bool:
        """Whether there is something to resume."""
        return (self.path / CHECKPOINT_FILE).is_file()

    def write_settings(self, settings: dict[str, Any]) -> None:
        """Store what the run was told.

        Raises:
            ValueError: If the folder holds a run with other settings.
        """
        file = self.path / SETTINGS_FILE
        if self.has_checkpoint and file.is_file():
            before = _read_settings(file)
            now = json.loads(json.dumps(settings))
            changed = sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
            if changed:
                raise ValueError(
                    f"{self.path} holds a run with another {', '.join(changed)}. "
                    "Resume it with the same settings or choose another folder."
                )
            return
        self.path.mkdir(parents=True, exist_ok=True)
        _replace(file, (json.dumps(settings, indent=2) + "\n").encode())

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

    def save_checkpoint(
        self, model: nn.Module, optimizer: torch.optim.Optimizer, step: int, best: float | None
    ) -> None:
        """Write model (buffers and codebook averages included), optimiser and counters."""
        tensors = {f"model.{name}": value.contiguous() for name, value in model.state_dict().items()}
        for index, state in optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{index}.{name}": value.contiguous() for name, value in state.items()}
        temporary = self.path / (CHECKPOINT_FILE + ".tmp")
        save_file(tensors, temporary, metadata={"progress": json.dumps({"step": step, "best": best})})
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(self.path / CHECKPOINT_FILE)

    def load_checkpoint(self, model: nn.Module, optimizer: torch.optim.Optimizer) -> tuple[int, float | None]:
        """Put the state back; returns the number of steps done and the best validation value.

        Raises:
            ValueError: If the checkpoint is damaged or belongs to another network.
        """
        file = self.path / CHECKPOINT_FILE
        try:
            with safe_open(file, framework="pt") as tensors:
                progress = json.loads(tensors.metadata()["progress"])
                state = {name: tensors.get_tensor(name) for name in tensors.keys()}  # noqa: SIM118
            model.load_state_dict(
                {
                    name.removeprefix("model."): value
                    for name, value in state.items()
                    if name.startswith("model.")
                }
            )
        except (SafetensorError, RuntimeError, KeyError, TypeError) as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"{file} is damaged or belongs to another network: {reason}") from error
        _load_optimizer(optimizer, {n: v for n, v in state.items() if n.startswith("optimizer.")})
        return progress["step"], progress["best"]


def _read_settings(file: Path) -> dict[str, Any]:
    try:
        settings: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{file} is damaged ({error}). Restore it or choose another folder.") from error
    return settings


def _load_optimizer(optimizer: torch.optim.Optimizer, tensors: dict[str, torch.Tensor]) -> None:
    packed = optimizer.state_dict()
    packed["state"] = {}
    for name, value in tensors.items():
        _, index, key = name.split(".")
        packed["state"].setdefault(int(index), {})[key] = value
    optimizer.load_state_dict(packed)


def _replace(path: Path, content: bytes) -> None:
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_bytes(content)
    temporary.replace(path)


def _rounded(value: float) -> float:
    return value if isinstance(value, int) else float(f"{value:.6g}")
