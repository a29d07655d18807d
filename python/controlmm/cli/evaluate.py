"""``controlmm evaluate``: the papers' protocol on a model, or on several side by side."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controlmm.cli.interruption import resumable
from controlmm.cli.output_folder import writable_folder

if TYPE_CHECKING:
    from controlmm.evaluation.control_draws import ControlSetting
    from controlmm.evaluation.protocol import Protocol, Row
    from controlmm.evaluation.test_set import TestSet
    from controlmm.pipelines.pipeline import MotionPipeline

KINDS = "annotator,written,kinematic"


def evaluate(
    data: Annotated[Path, typer.Option(help="HumanML3D / KIT-ML folder, or a folder of npz packs.")],
    out: Annotated[
        Path,
        typer.Option(help="Folder for results; the same command goes on in it.", callback=writable_folder),
    ],
    model: Annotated[
        list[Path] | None,
        typer.Option(help="Model folder; again for more. By default the model that comes with the package."),
    ] = None,
    control: Annotated[
        str,
        typer.Option(
            help="A joint, or several as left_wrist+head, or random (of six), cross (their combinations), "
            "lower (pelvis and feet), all (six), none."
        ),
    ] = "pelvis",
    density: Annotated[
        str, typer.Option(help="Keyframes: 1, 2, 5, 49, 196, or all (drawn for each clip).")
    ] = "all",
    preset: Annotated[
        list[str] | None, typer.Option(help="Preset, such as accurate; again for more. By default balanced.")
    ] = None,
    repeats: Annotated[int, typer.Option(help="Times, each with other draws.")] = 1,
    limit: Annotated[
        int | None,
        typer.Option(help="Clips a repeat, rounded down to whole batches of 32.", show_default="all"),
    ] = None,
    split: Annotated[str, typer.Option(help="train, val, test; all for every clip.")] = "test",
    captions: Annotated[str, typer.Option(help="Kinds of captions, comma-separated.")] = KINDS,
    sources: Annotated[
        str | None, typer.Option(help="Sources of clips, comma-separated.", show_default="all")
    ] = None,
    evaluator: Annotated[
        Path | None, typer.Option(help="Evaluator folder.", show_default="the one in the package")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of all draws.")] = 0,
    mask_padding: Annotated[
        bool, typer.Option("--mask-padding", help="Hide decoded padding from the published evaluator.")
    ] = False,
    multimodality: Annotated[
        int, typer.Option(help="Texts that get 30 motions each, for the column multimodality.")
    ] = 0,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar.")] = False,
) -> None:
    """Measure quality, control and time; real motion is the first row of every table."""
    from controlmm.evaluation.control_draws import ControlSetting
    from controlmm.evaluation.evaluators import load_evaluator
    from controlmm.evaluation.protocol import Protocol, evaluate_rows
    from controlmm.evaluation.reconstruction import code_statistics
    from controlmm.evaluation.report import ResultPage
    from controlmm.evaluation.test_set import read_test_set

    started = time.perf_counter()
    setting = ControlSetting(control, int(density) if density.isdigit() else density)
    protocol = Protocol(repeats, limit, seed, mask_padding, multimodality)
    judge = load_evaluator(evaluator)
    test_set = read_test_set(
        data, split=split, kinds=listed(captions), sources=listed(sources) if sources else None
    )
    setting.check(test_set.skeleton)
    pipelines = _pipelines(model or [])
    rows = _rows(pipelines, preset or ["balanced"], setting)
    with resumable(out):
        scores = evaluate_rows(rows, test_set, judge, protocol, out, progress=not quiet)
    clips = [item.features for item in test_set.items[: protocol.clips(len(test_set.items))]]
    codes = {name: code_statistics(pipeline.decoder, clips) for name, pipeline in pipelines.items()}
    facts = facts_of(test_set, protocol, seconds=time.perf_counter() - started)
    page = ResultPage(f"Control of {control}, density {density}", facts, scores, judge.caution, codes)
    page.write(out)
    typer.echo(page.markdown())


def command_line() -> str:
    """The command as it was typed."""
    return shlex.join(["controlmm", *sys.argv[1:]])


def _pipelines(models: Sequence[Path]) -> dict[str, MotionPipeline[Any]]:
    """The pipelines by name: that of their folder, or the kind of the one in the package."""
    from controlmm.pipelines.loading import load_pipeline

    if not models:
        shipped = load_pipeline(None)
        return {shipped.kind: shipped}
    names = [path.resolve().name for path in models]
    if len(set(names)) < len(names):
        raise ValueError(f"Model folders must have different names, got {', '.join(names)}.")
    return {name: load_pipeline(path) for name, path in zip(names, models, strict=True)}


def _rows(
    pipelines: Mapping[str, MotionPipeline[Any]], presets: list[str], setting: ControlSetting
) -> list[Row]:
    from controlmm.evaluation.motion_sources import Generated, RealMotion, Reconstruction
    from controlmm.evaluation.protocol import Row

    rows = [Row("real motion", RealMotion(), setting)]
    for name, pipeline in pipelines.items():
        rows.append(Row(f"{name}, reconstruction", Reconstruction(pipeline), setting))
        rows += [
            Row(f"{name}, {preset}", Generated(pipeline, pipeline.resolve_preset(preset, None)), setting)
            for preset in presets
        ]
    return rows


def facts_of(test_set: TestSet, protocol: Protocol, *, seconds: float) -> dict[str, object]:
    """What must be said beside numbers: command, revision, machine, seconds, data, captions, seed."""
    from controlmm.evaluation.machine import machine, revision

    sources = ", ".join(f"{name} {count}" for name, count in sorted(test_set.sources.items()))
    clips = protocol.clips(len(test_set.items))
    return {
        "command": f"`{command_line()}`",
        "revision": revision(),
        "machine": machine(),
        "seconds of this call": round(seconds, 1),
        "clips": f"{clips} a repeat of {len(test_set.items)} in the split {test_set.split} ({sources})",
        "captions": ", ".join(test_set.kinds),
        "repeats": protocol.repeats,
        "seed": protocol.seed,
    }


def listed(text: str) -> list[str]:
    """The parts of an option that holds several, comma-separated."""
    return [name.strip() for name in text.split(",") if name.strip()]
