"""``meta/mean.npy`` and ``meta/std.npy``: the feature statistics that belong to one published tokenizer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from controlmm.motion.normalizer import Normalizer


def read_statistics(run: Path) -> Normalizer:
    """The statistics in ``run/meta``, as they stand: the root and contact bias is in them already.

    Raises:
        FileNotFoundError: If a file is missing.
        ValueError: If a file is no array of numbers, or the arrays are no feature statistics.
    """
    mean, std = (_read(run / "meta" / name) for name in ("mean.npy", "std.npy"))
    try:
        return Normalizer(mean, std)
    except ValueError as error:
        raise ValueError(f"{run / 'meta'} holds no feature statistics: {error}") from error


def _read(path: Path) -> Tensor:
    if not path.is_file():
        raise FileNotFoundError(
            f"No {path.name} in {path.parent}. The tokenizer's own statistics are needed; no others fit."
        )
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"{path} is no plain array of numbers, or is damaged.") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind != "f":
        raise ValueError(f"{path} must hold floating-point numbers.")
    return torch.from_numpy(array.astype(np.float64))
