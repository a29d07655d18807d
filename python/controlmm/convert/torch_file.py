"""Files written by ``torch.save``, read without running anything that they hold."""

from __future__ import annotations

import pickle
import re
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

StateDict = dict[str, Tensor]


def read_torch_file(path: Path) -> dict[str, Any]:
    """The dictionary in a ``torch.save`` file, tensors on the CPU (mapped, not copied, where possible).

    Only tensors and plain values are read. A file with anything else is refused, never executed.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it holds other Python objects, is damaged, or is no dictionary.
    """
    if not path.is_file():
        raise FileNotFoundError(f"No checkpoint at {path}.")
    try:
        with warnings.catch_warnings(action="ignore"):
            loaded = torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    except pickle.UnpicklingError as error:
        name = _foreign_object(str(error))
        raise ValueError(
            f"{path} is refused: it is damaged or holds {name} beside tensors and plain values. "
            "Nothing of it was executed and nothing was written."
        ) from error
    except Exception as error:  # damaged bytes make the unpickler fail in every way there is
        raise ValueError(f"{path} is no readable torch file, or is damaged. Download it again.") from error
    if not isinstance(loaded, Mapping) or not all(isinstance(key, str) for key in loaded):
        raise ValueError(f"{path} must hold a dictionary with string keys, got {type(loaded).__name__}.")
    return dict(loaded)


def find_state_dict(loaded: Mapping[str, Any], names: Sequence[str]) -> StateDict | None:
    """The first of ``names`` in a checkpoint that is a state dict, its tensors in float32; else ``None``."""
    for name in names:
        if is_state_dict(loaded.get(name)):
            return as_float32(loaded[name])
    return None


def is_state_dict(value: object) -> bool:
    """Whether ``value`` is a non-empty dictionary of tensors."""
    return (
        isinstance(value, Mapping)
        and len(value) > 0
        and all(isinstance(name, str) and isinstance(tensor, Tensor) for name, tensor in value.items())
    )


def as_float32(state: Mapping[str, Tensor]) -> StateDict:
    """The tensors with every floating-point one in float32."""
    return {name: tensor.float() if tensor.is_floating_point() else tensor for name, tensor in state.items()}


def _foreign_object(message: str) -> str:
    """What the unpickler refused, if its message says so."""
    found = re.search(r"GLOBAL ([\w.]+)", message)
    return f"the Python object {found[1]}" if found else "Python objects"
