"""Random numbers that belong to a clip, whatever is drawn beside it and in what order."""

from __future__ import annotations

import hashlib

import torch


def stream_seed(*names: object) -> int:
    """A 63-bit seed that is a function of ``names`` alone: the run's seed, the repeat, the clip, what for."""
    digest = hashlib.blake2b("/".join(map(str, names)).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def stream(*names: object) -> torch.Generator:
    """A generator seeded with :func:`stream_seed`."""
    return torch.Generator().manual_seed(stream_seed(*names))


def draw(upper: int, generator: torch.Generator) -> int:
    """A whole number from 0 to ``upper - 1``."""
    return int(torch.randint(upper, (), generator=generator))
