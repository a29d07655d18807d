"""Interleaved timing: every contender runs in every round, so that a busy machine slows all of them alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch

EVICTION_BYTES = 48 << 20  # more than the innermost two caches of any core
_SHORTEST_BLOCK = 2e-3  # seconds: blocks of repeated calls, so that the clock's own cost does not count
_COLD_CALLS = 5  # single calls a round: one alone is noisy
_LONGEST_ROUND = 0.2  # seconds that the cold calls of one contender may take in a round


def _clock() -> float:
    """With one thread its processor time, which other programs do not lengthen by taking the core; else the
    time of day."""
    return time.thread_time() if torch.get_num_threads() == 1 else time.perf_counter()


def _once(run: Callable[[], object]) -> float:
    start = _clock()
    run()
    return _clock() - start


def _time_hot(run: Callable[[], object], calls: int) -> list[float]:
    run()  # brings back what the contender before evicted
    start = _clock()
    for _ in range(calls):
        run()
    return [(_clock() - start) / calls]


def _time_cold(run: Callable[[], object], calls: int, filler: torch.Tensor) -> list[float]:
    times = []
    for _ in range(calls):
        filler.add_(1)  # evicts what the call before left in the caches
        times.append(_once(run))
    return times


def interleaved(
    contenders: dict[str, Callable[[], object]], *, rounds: int, is_cold: bool
) -> dict[str, float]:
    """Median seconds of one call for each contender."""
    for run in contenders.values():
        run()
    once = {name: max(_once(run), 1e-7) for name, run in contenders.items()}
    filler = torch.zeros(EVICTION_BYTES // 4 if is_cold else 1)
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, run in contenders.items():
            if is_cold:
                calls = max(1, min(_COLD_CALLS, int(_LONGEST_ROUND / once[name])))
                times[name] += _time_cold(run, calls, filler)
            else:
                times[name] += _time_hot(run, max(1, int(_SHORTEST_BLOCK / once[name])))
    return {name: statistics.median(values) for name, values in times.items()}


def copy_bandwidth(*, megabytes: int = 256, rounds: int = 7) -> float:
    """Bytes read and written per second by a plain copy, best of several."""
    source = torch.zeros(megabytes << 18)
    target = torch.empty_like(source)
    target.copy_(source)
    return 2 * source.numel() * 4 / min(_once(lambda: target.copy_(source)) for _ in range(rounds))
