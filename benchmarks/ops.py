"""Operators against eager torch, interleaved: ``python -m benchmarks.ops [--quick] [--json FILE]``.

Ratios are those of medians of one run; absolute times move with the load of the machine, ratios much less.
"""

from __future__ import annotations

import argparse
import json
import time
import timeit
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from benchmarks import cases
from benchmarks.convolution_cases import FRAMES, convolutions
from benchmarks.exact_cases import exact
from benchmarks.timing import copy_bandwidth, interleaved
from controlmm import _core, ops

OURS = ("raw", "public")


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="B = 1 and 32, F = 196, one thread")
    parser.add_argument("--rounds", type=int, default=15, help="rounds of each measurement")
    parser.add_argument("--json", type=Path, default=None, help="write all figures to this file")
    return parser.parse_args()


def binding_microseconds() -> float:
    """Cost of passing three tensors into C++, measured with an empty batch."""
    features, joints = torch.empty(0, 3, 67), torch.empty(0, 3, 22, 3)
    calls = 200_000
    seconds = min(
        timeit.repeat(
            lambda: _core.recover_joints_backward(features, joints, features, 1),
            timer=time.thread_time,
            number=calls,
            repeat=5,
        )
    )
    return seconds / calls * 1e6


def _workloads(batch: int, frames: int, threads: int) -> list[cases.Workload]:
    return [
        *cases.kinematics(batch, frames, threads),
        cases.guidance(batch, frames, threads, obstacles=False),
        cases.guidance(batch, frames, threads, obstacles=True),
        *cases.losses(batch, frames),
    ]


def _measured(
    workload: cases.Workload, *, rounds: int, is_cold: bool, bandwidth: float, **where: int
) -> dict[str, Any]:
    times = interleaved(workload.contenders, rounds=rounds, is_cold=is_cold)
    row: dict[str, Any] = {"workload": workload.name, **where, "cache": "cold" if is_cold else "hot"}
    row["microseconds"] = {name: seconds * 1e6 for name, seconds in times.items()}
    row["ratios"] = {
        ours: {name: seconds / times[ours] for name, seconds in times.items() if name not in OURS}
        for ours in OURS
        if ours in times
    }
    if workload.bytes_moved:
        row["share_of_copy_bandwidth"] = workload.bytes_moved / times["raw"] / bandwidth
    return row


def _line(row: dict[str, Any]) -> str:
    place = f"B={row['batch']:<4} F={row['frames']:<4} {row['threads']} thr {row['cache']:<4}"
    parts = []
    for ours, ratios in row["ratios"].items():
        against = ", ".join(f"{name} {ratio:.1f}x" for name, ratio in ratios.items())
        parts.append(f"{ours} {row['microseconds'][ours]:.1f} us ({against})")
    share = row.get("share_of_copy_bandwidth")
    parts.append("" if share is None else f"{share:.2f} of copy")
    return f"{row['workload']:<56} {place}  " + "  ".join(parts)


def _all_rows(*, is_quick: bool, rounds: int, bandwidths: dict[int, float]) -> Iterator[dict[str, Any]]:
    for threads, bandwidth in bandwidths.items():
        torch.set_num_threads(threads)
        for batch in (1, 32) if is_quick else (1, 32, 256):
            fewer = max(3, rounds // (1 + batch // 64))
            for frames in (196,) if is_quick else (60, 196):
                where = {"batch": batch, "frames": frames, "threads": threads}
                for workload in _workloads(batch, frames, threads):
                    for is_cold in (False, True):
                        yield _measured(workload, rounds=fewer, is_cold=is_cold, bandwidth=bandwidth, **where)
        for tokens in (49, 1568):
            where = {"batch": tokens // 49, "frames": 196, "threads": threads}
            for workload in cases.gumbel(tokens, threads):
                yield _measured(workload, rounds=rounds, is_cold=False, bandwidth=bandwidth, **where)
        for batch in (1, 8, 32):
            where = {"batch": batch, "frames": FRAMES, "threads": threads}
            for workload in convolutions(batch):
                yield _measured(workload, rounds=rounds, is_cold=False, bandwidth=bandwidth, **where)
        for workload in exact(196):
            where = {"batch": 1, "frames": 196, "threads": threads}
            yield _measured(workload, rounds=rounds, is_cold=False, bandwidth=bandwidth, **where)


def main() -> None:
    arguments = _parse()
    bandwidths = {}
    for threads in (1,) if arguments.quick else (1, 2):
        torch.set_num_threads(threads)
        bandwidths[threads] = copy_bandwidth()
    torch.set_num_threads(1)
    binding = binding_microseconds()
    print(ops.build_info())
    for threads, bandwidth in bandwidths.items():
        print(f"copy bandwidth with {threads} threads: {bandwidth / 1e9:.1f} GB/s (read + write)")
    print(f"three tensors into C++: {binding:.2f} us", flush=True)
    rows = []
    for row in _all_rows(is_quick=arguments.quick, rounds=arguments.rounds, bandwidths=bandwidths):
        print(_line(row), flush=True)
        rows.append(row)
    if arguments.json:
        info = {
            "build": str(ops.build_info()),
            "instruction_set": ops.active_isa(),
            "copy_bytes_per_second": bandwidths,
            "binding_us": binding,
        }
        arguments.json.write_text(json.dumps({**info, "rows": rows}, indent=2))


if __name__ == "__main__":
    main()
