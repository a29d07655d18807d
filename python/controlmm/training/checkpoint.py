"""What a run needs to go on: network, optimiser, averaged weights, counters; one safetensors file."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from controlmm.training.averaging import WeightAverage


@dataclass
class Progress:
    """How far a run has come."""

    step: int = 0  # steps taken
    best: float | None = None  # best validation score
    best_step: int = 0
    stale: int = 0  # validations since then
    updates: int = 0  # of the averaged weights
    seconds: float = 0.0  # of work, over all starts


def save_checkpoint(
    file: Path, progress: Progress, model: nn.Module, optimizer: torch.optim.Optimizer, average: WeightAverage
) -> None:
    """Replace ``file`` as a whole; codebook averages and all other buffers of the network are included."""
    tensors = {f"model.{name}": value.contiguous() for name, value in model.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{name}": value.contiguous() for name, value in state.items()}
    tensors |= {f"average.{name}": value.contiguous() for name, value in average.state().items()}
    temporary = file.with_name(file.name + ".tmp")
    save_file(tensors, temporary, metadata={"progress": json.dumps(dataclasses.asdict(progress))})
    with temporary.open("rb") as written:
        os.fsync(written.fileno())
    temporary.replace(file)


def load_checkpoint(
    file: Path, model: nn.Module, optimizer: torch.optim.Optimizer, average: WeightAverage
) -> Progress:
    """Put the state back.

    Raises:
        ValueError: If the checkpoint is damaged or belongs to another network.
    """
    try:
        with safe_open(file, framework="pt") as tensors:
            progress = Progress(**json.loads(tensors.metadata()["progress"]))
            state = {name: tensors.get_tensor(name) for name in tensors.keys()}  # noqa: SIM118
        model.load_state_dict(_under("model", state))
        average.load_state(_under("average", state), updates=progress.updates)
    except (SafetensorError, RuntimeError, KeyError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{file} is damaged or belongs to another network: {reason}") from error
    _load_optimizer(optimizer, _under("optimizer", state))
    return progress


def _under(prefix: str, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    start = f"{prefix}."
    return {name.removeprefix(start): value for name, value in state.items() if name.startswith(start)}


def _load_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    packed = optimizer.state_dict()
    packed["state"] = {}
    for name, value in tensors.items():
        index, _, key = name.partition(".")
        packed["state"].setdefault(int(index), {})[key] = value
    optimizer.load_state_dict(packed)
