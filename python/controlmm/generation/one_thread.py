"""Arithmetic in one thread: the same to the bit on every machine's cores, and quick beside other programs.

Linear algebra adds up in another order when threads share the work. And threads that share small operators
wait for each other at every one, as long as another program lets them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


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
