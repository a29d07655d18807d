"""Arithmetic in one thread: the same to the bit on every machine's cores, and quick beside other programs.

Linear algebra adds up in another order when threads share the work. And threads that share small operators
wait for each other at every one, as long as another program lets them. More cores help where each has clips
of its own, see :mod:`controlmm.generation.side_by_side`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

_allowed: ContextVar[int | None] = ContextVar("controlmm_threads", default=None)


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread for the operators inside, also as a decorator: for what is small, or one clip's.

    The setting is the calling thread's own; other threads of a program keep theirs.
    """
    threads = torch.get_num_threads()
    outermost = _allowed.set(allowed_threads())
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        _allowed.reset(outermost)


def allowed_threads() -> int:
    """How many threads the caller of the outermost :func:`one_thread` lets torch use."""
    return _allowed.get() or torch.get_num_threads()


def take_one_core() -> None:
    """From now on one thread for this thread's operators, and no others to share its work with."""
    torch.set_num_threads(1)
    _allowed.set(1)
