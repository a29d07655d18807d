"""Body-part timelines: ten of two to four entries, each with facts that can be checked on the joints.

    python -m benchmarks.timelines --out out/timelines

Writes rows.jsonl as it goes (start it again to go on after a kill), summary.md, and a picture of each one.
Facts are those of controlmm.evaluation.facts, measured in the interval of their entry.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import get_args

from benchmarks.progress_file import Row, measured_rows
from controlmm import ControlMM, TimelineEntry
from controlmm.evaluation.facts import Range, measured_facts, missed
from controlmm.pipelines.timeline import TimelineMethod

Expected = Mapping[str, Range]
_WALK: Expected = {"forward_speed": (0.4, None)}
_STILL: Expected = {"speed": (None, 0.35)}
_RIGHT_UP: Expected = {"right_hand_up": (0.3, None)}
_LEFT_UP: Expected = {"left_hand_up": (0.3, None)}
_BOTH_UP: Expected = {**_RIGHT_UP, **_LEFT_UP}

# (part, prompt, start, end, facts); seconds
TIMELINES: dict[str, list[tuple[str, str, float, float, Expected]]] = {
    "walk and wave": [
        ("lower", "a person walks forward", 0, 6, _WALK),
        ("right_arm", "a person waves the right hand", 2, 5, _RIGHT_UP),
    ],
    "walk with raised hands": [
        ("lower", "a person walks forward", 0, 6, _WALK),
        ("upper", "a person raises both hands above the head", 1, 5, _BOTH_UP),
    ],
    "stand, one hand after the other": [
        ("lower", "a person stands still", 0, 6, _STILL),
        ("left_arm", "a person raises the left hand", 0, 3, _LEFT_UP),
        ("right_arm", "a person raises the right hand", 3, 6, _RIGHT_UP),
    ],
    "walk, then jump": [
        ("body", "a person walks forward", 0, 3, _WALK),
        ("body", "a person jumps", 3, 6, {"jump": (0.1, None)}),
    ],
    "jump, then walk": [
        ("body", "a person jumps", 0, 3, {"jump": (0.1, None)}),
        ("body", "a person walks forward", 3, 7, _WALK),
    ],
    "walk, sit": [
        ("body", "a person walks forward", 0, 3.5, _WALK),
        ("body", "a person sits down", 3.5, 7, {"lowering": (0.2, None)}),
    ],
    "walk, turn, walk": [
        ("body", "a person walks forward", 0, 3, _WALK),
        ("body", "a person turns around to the left", 3, 5.5, {"turned": (60, None)}),
        ("body", "a person walks forward", 5.5, 8, _WALK),
    ],
    "run and wave both": [
        ("lower", "a person runs forward", 0, 4, {"forward_speed": (1.2, None)}),
        ("arms", "a person waves both hands", 1, 3.5, _BOTH_UP),
    ],
    "bow, then walk and wave": [
        ("body", "a person bows", 0, 3, {"bow": (25, None)}),
        ("lower", "a person walks forward", 3, 7, _WALK),
        ("right_arm", "a person waves the right hand", 3.5, 6.5, _RIGHT_UP),
    ],
    "four parts": [
        ("lower", "a person walks forward", 0, 8, _WALK),
        ("left_arm", "a person raises the left hand", 0.5, 3, _LEFT_UP),
        ("right_arm", "a person raises the right hand", 3, 5.5, _RIGHT_UP),
        ("upper", "a person raises both hands above the head", 5.5, 8, _BOTH_UP),
    ],
}


def measure(pipeline: ControlMM, name: str, *, preset: str, method: TimelineMethod, pictures: Path) -> Row:
    """The row of a timeline: which facts of which entries hold."""
    rows = TIMELINES[name]
    entries = [TimelineEntry(part, prompt, seconds=(a, b)) for part, prompt, a, b, _ in rows]
    result = pipeline.timeline(entries, preset=preset, method=method, seed=1)
    result.best.save(pictures / f"{name.replace(' ', '_').replace(',', '')}.png", dpi=70)
    failed = [
        f"{entry.label}: {fact}"
        for entry, (*_, expected) in zip(entries, rows, strict=True)
        for fact in missed(measured_facts(result.best.joints[entry.start : entry.end]), expected)
    ]
    return {
        "entries": len(entries),
        "facts": sum(len(expected) for *_, expected in rows),
        "failed": failed,
        "held": 100 * result.control_error.item(),
        "seconds": result.seconds_taken,
    }


def summary(rows: Sequence[Row]) -> str:
    """A Markdown table, one row a timeline."""
    lines = [
        "| timeline | entries | facts that hold | held to (cm) | seconds | missed |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        good = row["facts"] - len(row["failed"])
        missing = "; ".join(row["failed"]) or "-"
        lines.append(
            f"| {row['key']} | {row['entries']} | {good} of {row['facts']} | {row['held']:.2f} | "
            f"{row['seconds']:.1f} | {missing} |"
        )
    facts, failed = (sum(row["facts"] for row in rows), sum(len(row["failed"]) for row in rows))
    lines.append(f"| all | {sum(row['entries'] for row in rows)} | {facts - failed} of {facts} | | | |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the suite."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", type=Path, help="model folder; by default the one that ships")
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--method", default="tracks", choices=get_args(TimelineMethod))
    parser.add_argument("--out", type=Path, default=Path("out/timelines"))
    arguments = parser.parse_args()
    pipeline = ControlMM.from_pretrained(arguments.model)
    rows = measured_rows(
        arguments.out / "rows.jsonl",
        TIMELINES,
        lambda name: measure(
            pipeline,
            name,
            preset=arguments.preset,
            method=arguments.method,
            pictures=arguments.out,
        ),
    )
    table = summary(rows)
    (arguments.out / "summary.md").write_text(
        f"Method `{arguments.method}`, preset `{arguments.preset}`.\n\n{table}"
    )
    print(table)


if __name__ == "__main__":
    main()
