"""Sums over clips that come out the same to the bit in every company.

Sums of floats depend on their order, and PyTorch's depends on how long a batch is padded.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def clip_sums(values: Float[Tensor, "B T *N"]) -> Float[Tensor, "B"]:
    """Sums of all values of each clip, frame after frame: frames of zeros behind its end change nothing."""
    frames = values.flatten(2).sum(2) if values.ndim > 2 else values
    from_nothing = torch.nn.functional.pad(frames.double(), (1, 0))  # there may be no frames
    sums: Tensor = from_nothing.cumsum(1)[:, -1].to(values.dtype)
    return sums
