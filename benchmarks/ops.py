"""Operators against eager torch, interleaved: ``python -m benchmarks.ops [--quick] [--json FILE]``.

Ratios are medians of one run; absolute times move with the load of the machine, ratios much less.
"""

from __future__ import annotations

import argparse
import json
import timeit
from pathlib import Path
from typing import Any

import torch

from benchmarks import cases
from benchmarks.timing import copy_bandwidth, interleaved
from controlmm import _core, ops


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="B = 1 and 32, F = 196, one thread, fewer rounds"
    )
    parser.add_argument("--rounds", type=int, default=None, help="rounds of each measurement")
    parser.add_argument("--json", type=Path, default=None, help="write all figures to this file")
    return parser.parse_args()


def binding_microseconds() -> float:
    """Cost of passing three tensors into C++, measured with an empty batch."""
    features, joints = torch.empty(0, 3, 67), torch.empty(0, 3, 22, 3)
    calls = 200_000
    seconds = min(
        timeit.repeat(
            lambda: _core.recover_joints_backward(features, joints, features, 1), number=calls, repeat=3
        )
    )
    return seconds / calls * 1e6


def _workloads(batch: int, frames: int, threads: int) -> list[cases.Workload]:
    loads = cases.kinematics(batch, frames, threads)
    loads.append(cases.guidance(batch, frames, obstacles=False))
    if frames == 196 and batch <= 32:
        loads.append(cases.guidance(batch, frames, obstacles=True))
    return loads


def _measure(
    workload: cases.Workload, *, rounds: int, is_cold: bool, bandwidth: float, **where: int
) -> dict[str, Any]:
    times = interleaved(workload.contenders, rounds=rounds, is_cold=is_cold)
    native = times["native"]
    row: dict[str, Any] = {"workload": workload.name, **where, "cache": "cold" if is_cold else "hot"}
    row["native_us"] = native * 1e6
    row["ratios"] = {name: seconds / native for name, seconds in times.items() if name != "native"}
    if workload.bytes_moved:
        row["share_of_copy_bandwidth"] = workload.bytes_moved / native / bandwidth
    return row


def _print(row: dict[str, Any]) -> None:
    ratios = "  ".join(f"{name} {ratio:6.1f}x" for name, ratio in row["ratios"].items())
    share = row.get("share_of_copy_bandwidth")
    place = f"B={row['batch']:<4} F={row['frames']:<4} {row['threads']} thr {row['cache']:<4}"
    bandwidth = "" if share is None else f"  {share:.2f} of copy"
    print(f"{row['workload']:<52} {place} {row['native_us']:10.1f} us  {ratios}{bandwidth}", flush=True)


def main() -> None:
    arguments = _parse()
    rounds = arguments.rounds or (7 if arguments.quick else 15)
    torch.set_num_threads(1)
    bandwidth = copy_bandwidth()
    binding = binding_microseconds()
    print(ops.build_info())
    print(
        f"copy bandwidth {bandwidth / 1e9:.1f} GB/s (read + write), three tensors into C++ {binding:.2f} us"
    )
    rows = []
    for threads in (1,) if arguments.quick else (1, 2):
        torch.set_num_threads(threads)
        for batch in (1, 32) if arguments.quick else (1, 32, 256):
            for frames in (196,) if arguments.quick else (60, 196):
                for workload in _workloads(batch, frames, threads):
                    for is_cold in (False, True):
                        row = _measure(
                            workload,
                            rounds=max(3, rounds // (1 + batch // 64)),
                            is_cold=is_cold,
                            bandwidth=bandwidth,
                            batch=batch,
                            frames=frames,
                            threads=threads,
                        )
                        _print(row)
                        rows.append(row)
        for tokens in (49, 1568):
            for workload in cases.gumbel(tokens):
                where = {"batch": 1, "frames": tokens, "threads": threads}
                row = _measure(workload, rounds=rounds, is_cold=False, bandwidth=bandwidth, **where)
                _print(row)
                rows.append(row)
    if arguments.json:
        info = {"build": str(ops.build_info()), "copy_bytes_per_second": bandwidth, "binding_us": binding}
        arguments.json.write_text(json.dumps({**info, "rows": rows}, indent=2))


if __name__ == "__main__":
    main()
