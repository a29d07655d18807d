"""``controlmm reproduce``: a paper's table with our rows beneath the published ones."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controlmm.cli.evaluate import KINDS, facts_of, listed

if TYPE_CHECKING:
    from controlmm.evaluation.protocol import Protocol
    from controlmm.evaluation.test_set import TestSet
    from controlmm.pipelines.controlmm import ControlMM

CONFIDENCE = "confidence"  # Figures 7 to 11
_TABLES = "table1 to table9, confidence (Figures 7 to 11)"


def reproduce(
    table: Annotated[str, typer.Argument(help=_TABLES)],
    data: Annotated[Path, typer.Option(help="HumanML3D folder, or a folder of npz packs.")],
    out: Annotated[Path, typer.Option(help="Folder for results; the same command goes on in it.")],
    model: Annotated[
        Path | None, typer.Option(help="ControlMM folder.", show_default="the one in the package")
    ] = None,
    limit: Annotated[
        int | None, typer.Option(help="Clips a row and repeat, for a quick look.", show_default="all")
    ] = None,
    effort: Annotated[
        float, typer.Option(help="Share of the papers' editing iterations, for a quick look.")
    ] = 1.0,
    preset: Annotated[
        list[str] | None, typer.Option(help="A preset of ours to add rows for; again for more.")
    ] = None,
    repeats: Annotated[int, typer.Option(help="Times, each with other draws.")] = 1,
    captions: Annotated[str, typer.Option(help="Kinds of captions, comma-separated.")] = KINDS,
    evaluator: Annotated[
        Path | None, typer.Option(help="Evaluator folder.", show_default="the one in the package")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of all draws.")] = 0,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar.")] = False,
) -> None:
    """Print a table of the paper with our rows beneath; write it, JSON and pictures to a folder."""
    from controlmm.cli.result_pictures import save_pictures
    from controlmm.evaluation.controlmm_tables import TABLES, Study
    from controlmm.evaluation.evaluators import load_evaluator
    from controlmm.evaluation.protocol import Protocol, evaluate_rows
    from controlmm.evaluation.report import write_json
    from controlmm.evaluation.test_set import read_test_set
    from controlmm.pipelines import ControlMM
    from controlmm.pipelines.presets import preset_named

    started = time.perf_counter()
    if table not in (*TABLES, CONFIDENCE):
        raise ValueError(f"Unknown table {table!r}. Tables: {', '.join((*TABLES, CONFIDENCE))}.")
    for name in preset or ():
        preset_named(name)
    protocol = Protocol(repeats, limit, seed)
    study = Study(ControlMM.from_pretrained(model), effort, tuple(preset or ()))
    test_set = read_test_set(data, kinds=listed(captions))
    if table == CONFIDENCE:
        _confidence(study.pipeline, test_set, protocol, effort, out)
        return
    judge = load_evaluator(evaluator)
    plan = TABLES[table](study)
    scores = evaluate_rows(plan.rows, test_set, judge, protocol, out, progress=not quiet)
    facts = facts_of(test_set, protocol, seconds=time.perf_counter() - started)
    facts["editing iterations"] = "the paper's" if effort == 1 else f"{effort:g} of the paper's"
    notes = [*plan.notes, judge.caution]
    text = _page(f"{table}: {plan.published.title}", facts, plan.markdown(scores), notes)
    (out / f"{table}.md").write_text(text, encoding="utf-8")
    write_json(out / f"{table}.json", {"table": table, **facts, "rows": [s.as_json() for s in scores]})
    typer.echo(text)
    for picture in save_pictures(plan, scores, out):
        typer.echo(str(picture))


def _page(title: str, facts: dict[str, Any], table: str, notes: list[str]) -> str:
    said = "\n".join(f"- {name}: {value}" for name, value in facts.items())
    foot = "\n".join(f"- {note}" for note in notes)
    return f"# {title}\n\n{table}\n\n{foot}\n\n{said}\n"


def _confidence(pipeline: ControlMM, test_set: TestSet, protocol: Protocol, effort: float, out: Path) -> None:
    """One batch of pelvis control at a quarter of the frames."""
    from controlmm.evaluation.confidence import confidence_records, mean_confidence
    from controlmm.evaluation.control_draws import ControlSetting
    from controlmm.evaluation.motion_sources import Batch
    from controlmm.evaluation.protocol import batches_of
    from controlmm.evaluation.report import pipe_table
    from controlmm.viewer.evaluation_charts import save_confidence

    started = time.perf_counter()
    samples, masks = zip(*next(batches_of(test_set, ControlSetting("pelvis", 49), protocol, 0)), strict=True)
    batch = Batch.of(samples, masks, seed=protocol.seed, repeat=0)
    records = confidence_records(pipeline, batch, iterations=max(1, round(100 * effort)))
    steps = [str(step + 1) for step in range(len(records[0].mean))]
    table = pipe_table(["step", *steps], mean_confidence(records))
    facts = facts_of(test_set, protocol, seconds=time.perf_counter() - started)
    facts["clips"] = len(samples)
    text = _page("Confidence in each decoding step (Figures 7 to 11)", facts, table, [])
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{CONFIDENCE}.md").write_text(text, encoding="utf-8")
    typer.echo(text)
    maps = {record.label: record.by_position for record in records}
    typer.echo(str(save_confidence(maps, out / f"{CONFIDENCE}.png")))
