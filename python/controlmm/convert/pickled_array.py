"""Vectors of numbers in published files: plain arrays, pickled ones, tensors; nothing is executed."""

from __future__ import annotations

import io
import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

_NUMPY = ("numpy.core.multiarray", "numpy._core.multiarray")  # before and since NumPy 2
_ALLOWED = {
    *((module, name) for module in _NUMPY for name in ("_reconstruct", "scalar")),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),  # how protocol 2 writes bytes
    *((module, "_frombuffer") for module in ("numpy.core.numeric", "numpy._core.numeric")),  # protocol 5
}


def read_vector(path: Path) -> Tensor:
    """The one-dimensional floating-point array in ``path``, float64: ``.npy``, a pickled array, or a tensor.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file holds anything else, or is damaged.
    """
    if not path.is_file():
        raise FileNotFoundError(f"No file at {path}.")
    content = path.read_bytes()
    for read in (_plain, _tensor, _pickled):
        try:
            value = torch.as_tensor(read(content))
        except Exception:  # damaged bytes fail in every way there is; the next reader may know them
            continue
        if value.is_floating_point() and value.squeeze().ndim == 1:
            return value.double().flatten()
    raise ValueError(
        f"{path} is refused: it must hold one vector of floating-point numbers, as an array or a tensor. "
        "Nothing of it was executed."
    )


class _ArrayUnpickler(pickle.Unpickler):
    """Knows how to make an array of numbers and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name} is not allowed.")
        return super().find_class(module, name)


def _plain(content: bytes) -> Any:
    return np.load(io.BytesIO(content), allow_pickle=False)


def _tensor(content: bytes) -> Any:
    with warnings.catch_warnings(action="ignore"):  # it warns of pickles that are not its own
        return torch.load(io.BytesIO(content), weights_only=True)


def _pickled(content: bytes) -> Any:
    return _ArrayUnpickler(io.BytesIO(content)).load()
