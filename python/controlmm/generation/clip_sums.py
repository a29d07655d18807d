"""Sums over clips, and arithmetic on one clip, that come out the same to the bit in every company.

Sums of floats depend on their order. PyTorch's depends on how long a batch is padded; that of linear algebra
on how many threads share the work.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Float
from torch import Tensor


def clip_sums(values: Float[Tensor, "B T *N"]) -> Float[Tensor, "B"]:
    """Sums of all values of each clip, frame after frame: frames of zeros behind its end change nothing."""
    frames = values.flatten(2).sum(2) if values.ndim > 2 else values
    from_nothing = torch.nn.functional.pad(frames.double(), (1, 0))  # there may be no frames
    sums: Tensor = from_nothing.cumsum(1)[:, -1].to(values.dtype)
    return sums


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread for the operators inside, also as a decorator: for what is small, or one clip's.

    The setting is the calling thread's own; other threads of a program keep theirs.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
