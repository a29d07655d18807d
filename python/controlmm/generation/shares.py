"""A batch in shares that are worked on side by side: a core for each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch
from jaxtyping import Int
from torch import Tensor

from controlmm.generation.side_by_side import side_by_side
from controlmm.generation.solvers import Progress

Work = Callable[[Int[Tensor, "N"], Progress | None], Tensor]  # clips -> a row for each of them


def in_shares(
    work: Work, costs: Sequence[float], *, threads: int, progress: Progress | None = None
) -> Tensor:
    """What ``work`` makes of all clips of a batch.

    Args:
        work: Makes rows of the same size for any of the clips; none may depend on the clips beside it.
        costs: What each clip costs, in any unit.
        threads: Most shares.
        progress: Called from this thread, for the share that is farthest behind.
    """
    shares = shares_of(costs, threads)
    parts = side_by_side([partial(work, rows) for rows in shares], progress=progress)
    return torch.cat(parts)[torch.cat(shares).argsort()]


def shares_of(costs: Sequence[float], count: int) -> list[Int[Tensor, "N"]]:
    """The clips of up to ``count`` shares that cost about the same.

    The dearest are dealt first, each to the share that is cheapest so far.
    """
    count = max(1, min(count, len(costs)))
    shares: list[list[int]] = [[] for _ in range(count)]
    totals = [0.0] * count
    for clip in sorted(range(len(costs)), key=lambda clip: -costs[clip]):
        cheapest = totals.index(min(totals))
        shares[cheapest].append(clip)
        totals[cheapest] += costs[clip]
    return [torch.tensor(sorted(share), dtype=torch.int64) for share in shares]
