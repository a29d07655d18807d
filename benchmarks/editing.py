"""The table of editing: what every solver reaches, in which time, at which cost in naturalness.

    python -m benchmarks.editing --data DATA [--split test] [--limit 32] [--seed 0] [--out out/editing]
    python -m benchmarks.editing --evaluation

Clips of the split, each with its own recording as target: the pelvis, each other of the six joints, one
of their 63 combinations ("cross"), at 1, 2, 5 keyframes, a quarter and all frames. Every solver starts
from the same tokens, those that ``accurate`` draws. Errors, seconds and evaluations are medians over
clips; seconds are processor seconds of the editing of one clip alone, so that a busy machine does not
count. FID, R-precision and the distance to the text are those of the in-project evaluator.
``paper-accurate`` takes 1,600 evaluations and logits editing of its own, whose time counts, so it runs on
``--slow-limit`` clips and comes last; scores that need 32 clips are then a dash. ``gauss-newton`` is
preset ``accurate``, ``latents alone`` the same to 1 mm without a closed end. "Worth" are the seconds in
plain evaluations of the same clip: value and gradient of the controlled channels.

A killed run goes on where it was, and the tables are written after every row. Two processes with different
``--controls`` may share ``--out``. With 32 clips and 4 slow ones, a choice of joints and keyframes takes
about 65 seconds of processor time, so all 35 take 40 minutes of one core (a Xeon with AVX-512).

``--evaluation`` prints what one evaluation of a paper-sized decoder costs, by part.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch

from benchmarks.decoder_evaluation import print_evaluations
from benchmarks.editing_rows import PLANS, REAL, Bench, is_slow
from benchmarks.progress_file import Row, known_rows, measured_rows
from controlmm import ControlMM
from controlmm.evaluation.control_draws import DENSITIES, ControlSetting
from controlmm.evaluation.evaluators import load_evaluator
from controlmm.evaluation.protocol import Protocol
from controlmm.evaluation.test_set import read_test_set
from controlmm.motion.skeleton import HUMANML3D
from controlmm.text.encoder import weights_sha256

CONTROLS = (*(HUMANML3D.joint_names[joint] for joint in HUMANML3D.control_joints), "cross")
_FRAMES = {1: "1", 2: "2", 5: "5", 49: "25 %", 196: "100 %"}
_COLUMNS = {
    "error (cm)": ("error_cm", "{:.3f}"),
    "worst (cm)": ("worst_cm", "{:.2f}"),
    "seconds": ("seconds", "{:.2f}"),
    "evaluations": ("evaluations", "{:.0f}"),
    "worth": ("worth", "{:.1f}"),
    "FID": ("fid", "{:.2f}"),
    "R@3": ("r3", "{:.3f}"),
    "to text": ("mm_distance", "{:.2f}"),
    "skating": ("skating", "{:.4f}"),
    "jerk": ("jerk", "{:.1f}"),
    "bones (mm)": ("bones_mm", "{:.2f}"),
    "clips": ("clips", "{:.0f}"),
}


def keys_of(solvers: Sequence[str], controls: Sequence[str], densities: Sequence[int]) -> list[str]:
    """Names of all rows, ``solver/control/density``: recordings once, and last what takes hours."""
    problems = [f"{control}/{density}" for control in controls for density in densities]
    slow = [solver for solver in solvers if is_slow(solver)]
    quick = [solver for solver in solvers if solver not in slow]
    return [
        f"{REAL}/{CONTROLS[0]}/{DENSITIES[0]}",
        *(f"{solver}/{problem}" for problem in problems for solver in quick),
        *(f"{solver}/{problem}" for solver in slow for problem in problems),
    ]


def table(rows: Sequence[Row]) -> str:
    """Markdown, one table a choice of joints, and the means over all of them."""
    parts = []
    measured = [row for row in rows if not row["key"].startswith(REAL)]
    for control in dict.fromkeys(row["key"].split("/")[1] for row in measured):
        own = [row for row in measured if row["key"].split("/")[1] == control]
        own.sort(key=lambda row: int(row["key"].split("/")[2]))
        cells = [(_FRAMES[int(row["key"].split("/")[2])], row["key"].split("/")[0], row) for row in own]
        parts.append(f"## {control}\n\n{_markdown(('keys', 'solver'), cells)}")
    means = [(*_wide(solver), _mean(solver, measured)) for solver in PLANS if _of(solver, measured)]
    real = [(*_wide(REAL), row) for row in rows if row["key"].startswith(REAL)]
    return "\n".join(
        [f"## means over {_problems(measured)}\n\n{_markdown(('rows', 'solver'), real + means)}", *parts]
    )


def _wide(solver: str) -> tuple[str, str]:
    return "all", solver


def _of(solver: str, rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if row["key"].startswith(f"{solver}/")]


def _problems(rows: Sequence[Row]) -> str:
    counts = {len(_of(solver, rows)) for solver in PLANS} - {0}
    return f"{min(counts, default=0)} to {max(counts, default=0)} problems a solver"


def _mean(solver: str, rows: Sequence[Row]) -> Row:
    own = _of(solver, rows)
    return {name: sum(row[name] for row in own) / len(own) for name, _ in _COLUMNS.values()}


def _markdown(titles: tuple[str, str], rows: Sequence[tuple[str, str, Row]]) -> str:
    lines = [f"| {' | '.join((*titles, *_COLUMNS))} |", "|" + " --- |" * (2 + len(_COLUMNS))]
    for first, second, row in rows:
        cells = [_cell(row[name], layout) for name, layout in _COLUMNS.values()]
        lines.append(f"| {first} | {second} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _cell(value: float, layout: str) -> str:
    """A number; a dash for a score of too few clips."""
    return "-" if math.isnan(value) else layout.format(value)


@torch.no_grad()
def run(arguments: argparse.Namespace) -> None:
    """Measure what is not measured yet; write ``rows.jsonl``, ``editing.json`` and ``editing.md``."""
    pipeline = ControlMM.from_pretrained(arguments.model)
    test_set = read_test_set(arguments.data, split=arguments.split)
    protocol = Protocol(limit=arguments.limit, seed=arguments.seed)
    about = {
        "split": arguments.split, "data": test_set.sha256, "protocol": asdict(protocol),
        "slow_limit": arguments.slow_limit,
        "networks": {name: weights_sha256(network) for name, network in pipeline.networks().items()},
    }  # fmt: skip
    out: Path = arguments.out
    _claim(out, about)
    evaluator = load_evaluator(arguments.evaluator)
    bench = Bench(pipeline, evaluator, test_set, protocol, slow_limit=arguments.slow_limit)
    file = out / "rows.jsonl"

    def measure(key: str) -> Row:
        solver, control, density = key.split("/")
        row = bench.row(solver, ControlSetting(control, int(density)))
        (out / "editing.md").write_text(table([*known_rows(file).values(), {"key": key, **row}]))
        return row

    measured_rows(file, keys_of(arguments.solvers, arguments.controls, arguments.densities), measure)
    rows = list(known_rows(file).values())  # also those of a process beside this one
    (out / "editing.md").write_text(table(rows))
    (out / "editing.json").write_text(json.dumps({**about, "rows": rows}, indent=2) + "\n")
    print(table(rows))


def _claim(out: Path, about: dict[str, object]) -> None:
    """Rows of other weights or clips must not end up in one table."""
    out.mkdir(parents=True, exist_ok=True)
    file, text = out / "about.json", json.dumps(about, indent=2, sort_keys=True) + "\n"
    if file.is_file() and file.read_text() != text:
        raise SystemExit(f"{out} holds rows of another model, split, limit or seed. Choose another `--out`.")
    file.write_text(text)


def main() -> None:
    """Parse the command line and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="HumanML3D-style folder")
    parser.add_argument("--split", default="test")
    parser.add_argument(
        "--limit", type=int, default=32, help="clips a row; FID means little below a few hundred"
    )
    parser.add_argument("--slow-limit", type=int, default=4, help="clips a row of paper-accurate")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--model", type=Path, help="model folder; by default the one that ships")
    parser.add_argument("--evaluator", type=Path, help="evaluator folder; by default the one that ships")
    parser.add_argument("--solvers", nargs="*", default=list(PLANS), choices=list(PLANS))
    parser.add_argument("--controls", nargs="*", default=list(CONTROLS), choices=list(CONTROLS))
    parser.add_argument("--densities", nargs="*", type=int, default=list(DENSITIES), choices=list(DENSITIES))
    parser.add_argument("--out", type=Path, default=Path("out/editing"))
    parser.add_argument("--evaluation", action="store_true", help="milliseconds of one evaluation by part")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.evaluation:
        print_evaluations()
    if arguments.data:
        run(arguments)


if __name__ == "__main__":
    main()
