"""Interleaved timing: every contender runs in every round, so that a busy machine slows all of them alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch

EVICTION_BYTES = 48 << 20  # more than the last-level cache slice of one core
_SHORTEST_BLOCK = 2e-3  # seconds: blocks of repeated calls, so that the clock's own cost does not count


def _calls_for(run: Callable[[], object]) -> int:
    start = time.perf_counter()
    run()
    once = time.perf_counter() - start
    return max(1, int(_SHORTEST_BLOCK / max(once, 1e-7)))


def _time_hot(run: Callable[[], object], calls: int) -> float:
    run()  # brings back what the contender before evicted
    start = time.perf_counter()
    for _ in range(calls):
        run()
    return (time.perf_counter() - start) / calls


def _time_cold(run: Callable[[], object], filler: torch.Tensor) -> float:
    filler.add_(1)  # evicts what the call before left in the caches
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def interleaved(
    contenders: dict[str, Callable[[], object]], *, rounds: int, is_cold: bool
) -> dict[str, float]:
    """Median seconds of one call for each contender."""
    for run in contenders.values():
        run()
        run()
    calls = {name: _calls_for(run) for name, run in contenders.items()}
    filler = torch.zeros(EVICTION_BYTES // 4 if is_cold else 1)
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, run in contenders.items():
            seconds = _time_cold(run, filler) if is_cold else _time_hot(run, calls[name])
            times[name].append(seconds)
    return {name: statistics.median(values) for name, values in times.items()}


def copy_bandwidth(*, megabytes: int = 256, rounds: int = 7) -> float:
    """Bytes read and written per second by a plain copy, best of several."""
    source = torch.zeros(megabytes << 18)
    target = torch.empty_like(source)
    target.copy_(source)
    best = float("inf")
    for _ in range(rounds):
        start = time.perf_counter()
        target.copy_(source)
        best = min(best, time.perf_counter() - start)
    return 2 * source.numel() * 4 / best
