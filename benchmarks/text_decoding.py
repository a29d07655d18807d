"""How strongly the text counts, how many codes can be drawn, how many steps: chosen on the validation split.

    python -m benchmarks.text_decoding --data DATA --out out/text_decoding

Motions follow a text only. The in-project evaluator judges them by R-precision and FID; one option is changed
at a time. Start the same command again to go on after a kill.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from controlmm import ControlMM
from controlmm.evaluation.control_draws import ControlSetting
from controlmm.evaluation.evaluators import load_evaluator
from controlmm.evaluation.motion_sources import Generated, RealMotion, Reconstruction
from controlmm.evaluation.protocol import Protocol, Row, evaluate_rows
from controlmm.evaluation.report import Column, markdown_table
from controlmm.evaluation.test_set import read_test_set
from controlmm.pipelines.presets import PRESETS, Preset

COLUMNS = (
    Column("R3", "r3"),
    Column("MM-Dist", "mm_distance"),
    Column("FID", "fid"),
    Column("Div", "diversity"),
    Column("skating", "skating", 4),
)


def variants() -> dict[str, Preset]:
    """The default, and presets that differ from it in one option."""
    default = PRESETS["balanced"]
    return {
        "default": default,
        **{f"guidance {s:g}": replace(default, guidance_scale=s) for s in (1.0, 1.5, 2.0, 3.0, 6.0)},
        **{
            f"residual guidance {s:g}": replace(default, residual_guidance_scale=s)
            for s in (1.0, 2.0, 3.0, 7.0)
        },
        **{
            f"top share {share:g}": replace(default, rules=replace(default.rules, text_top_share=share))
            for share in (0.02, 0.05, 0.2, 1.0)
        },
        **{
            f"guided share {share:g}": replace(default, guided_share=share)
            for share in (0.0, 0.25, 0.75, 1.0)
        },
        **{f"steps {steps}": replace(default, steps=steps) for steps in (5, 10, 18)},
    }


def main() -> None:
    """Run all, or those whose names begin with what ``--only`` says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--model", type=Path, help="model folder; by default the one that ships")
    parser.add_argument("--limit", type=int, default=320, help="clips; whole groups of 32")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--only", nargs="*", default=[""], help="beginnings of names")
    parser.add_argument("--out", type=Path, default=Path("out/text_decoding"))
    arguments = parser.parse_args()
    pipeline = ControlMM.from_pretrained(arguments.model)
    chosen = {name: p for name, p in variants().items() if name.startswith(tuple(arguments.only))}
    free = ControlSetting("none")
    rows = [
        Row("real", RealMotion(), free),
        Row("reconstruction", Reconstruction(pipeline), free),
        *(Row(name, Generated(pipeline, preset), free) for name, preset in chosen.items()),
    ]
    scores = evaluate_rows(
        rows,
        read_test_set(arguments.data, split="val"),
        load_evaluator(None),
        Protocol(arguments.repeats, arguments.limit, 0),
        arguments.out,
    )
    table = markdown_table(scores, COLUMNS)
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "summary.md").write_text(f"{arguments.limit} validation clips.\n\n{table}\n")
    print(table)


if __name__ == "__main__":
    main()
