"""``controlmm reproduce``: a paper's table with our rows beneath the published ones."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controlmm.cli.evaluate import KINDS, facts_of, listed
from controlmm.cli.interruption import resumable

if TYPE_CHECKING:
    from controlmm.evaluation.protocol import Protocol
    from controlmm.evaluation.reproduction import Reproduction
    from controlmm.evaluation.scores import RowScores
    from controlmm.evaluation.test_set import TestSet

CONFIDENCE = "confidence"  # Figures 7 to 11
_TABLES = "table1 to table10, confidence (Figures 7 to 11); of TLControl: tl-table1 to tl-table4, tl-fig7."


def reproduce(
    table: Annotated[str, typer.Argument(help=_TABLES)],
    data: Annotated[Path, typer.Option(help="HumanML3D folder, or a folder of npz packs.")],
    out: Annotated[
        Path, typer.Option(help="Folder; the table gets one in it, where the same command goes on.")
    ],
    model: Annotated[
        Path | None, typer.Option(help="ControlMM folder.", show_default="the one in the package")
    ] = None,
    tlcontrol: Annotated[
        Path | None,
        typer.Option(help="TLControl folder, for the tl- tables.", show_default="the one in the package"),
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
    from controlmm.evaluation.evaluators import load_evaluator
    from controlmm.evaluation.protocol import Protocol, evaluate_rows
    from controlmm.evaluation.test_set import read_test_set

    started = time.perf_counter()
    protocol = Protocol(repeats, limit, seed)
    if table == CONFIDENCE:
        _confidence(model, read_test_set(data, kinds=listed(captions)), protocol, effort, out)
        return
    plan = _plan(table, model, tlcontrol, effort, tuple(preset or ()))
    judge = load_evaluator(evaluator)
    test_set = read_test_set(data, kinds=listed(captions))
    with resumable(out / table):
        scores = evaluate_rows(plan.rows, test_set, judge, protocol, out / table, progress=not quiet)
    facts = facts_of(test_set, protocol, seconds=time.perf_counter() - started)
    facts["editing iterations"] = "the paper's" if effort == 1 else f"{effort:g} of the paper's"
    _write(plan, scores, facts, judge.caution, out / table)
    for picture in save_pictures(plan, scores, out / table, effort=effort):
        typer.echo(str(picture))


def _plan(
    table: str, model: Path | None, tlcontrol: Path | None, effort: float, presets: tuple[str, ...]
) -> Reproduction:
    from controlmm.evaluation.controlmm_tables import TABLES, Study
    from controlmm.evaluation.tlcontrol_tables import TABLES as TL_TABLES
    from controlmm.evaluation.tlcontrol_tables import Duel
    from controlmm.pipelines import ControlMM, TLControl
    from controlmm.pipelines.presets import preset_named

    if table not in TABLES and table not in TL_TABLES:
        raise ValueError(f"Unknown table {table!r}. Tables: {', '.join((*TABLES, CONFIDENCE, *TL_TABLES))}.")
    for name in presets:
        preset_named(name)
    study = Study(ControlMM.from_pretrained(model), effort, presets)
    if table in TABLES:
        return TABLES[table](study)
    duel = Duel(TLControl.from_pretrained(tlcontrol), study.pipeline, presets or ("balanced",))
    return TL_TABLES[table](duel)


def _write(
    plan: Reproduction, scores: list[RowScores], facts: dict[str, Any], caution: str, out: Path
) -> None:
    """Print the table; write it as Markdown and JSON."""
    from controlmm.evaluation.report import write_json

    text = _page(f"{plan.name}: {plan.published.title}", facts, plan.markdown(scores), [*plan.notes, caution])
    (out / f"{plan.name}.md").write_text(text, encoding="utf-8")
    rows = [score.as_json() for score in scores]
    write_json(out / f"{plan.name}.json", {"table": plan.name, **facts, "caution": caution, "rows": rows})
    typer.echo(text)


def _page(title: str, facts: dict[str, Any], table: str, notes: list[str]) -> str:
    said = "\n".join(f"- {name}: {value}" for name, value in facts.items())
    parts = [f"# {title}", table, "\n".join(f"- {note}" for note in notes), said]
    return "\n\n".join(part for part in parts if part) + "\n"


def _confidence(model: Path | None, test_set: TestSet, protocol: Protocol, effort: float, out: Path) -> None:
    """One batch of pelvis control at a quarter of the frames."""
    from controlmm.evaluation.confidence import confidence_records, mean_confidence
    from controlmm.evaluation.control_draws import ControlSetting
    from controlmm.evaluation.motion_sources import Batch
    from controlmm.evaluation.protocol import batches_of
    from controlmm.evaluation.report import pipe_table
    from controlmm.pipelines import ControlMM
    from controlmm.viewer.evaluation_charts import save_confidence

    started = time.perf_counter()
    samples, masks = zip(*next(batches_of(test_set, ControlSetting("pelvis", 49), protocol, 0)), strict=True)
    out = out / CONFIDENCE
    batch = Batch.of(samples, masks, seed=protocol.seed, repeat=0)
    records = confidence_records(
        ControlMM.from_pretrained(model), batch, iterations=max(1, round(100 * effort))
    )
    steps = [str(step + 1) for step in range(len(records[0].mean))]
    table = pipe_table(["step", *steps], mean_confidence(records))
    facts = facts_of(test_set, protocol, seconds=time.perf_counter() - started)
    facts["clips"] = len(samples)
    text = _page("Confidence in each decoding step (Figures 7 to 11)", facts, table, [])
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{CONFIDENCE}.md").write_text(text, encoding="utf-8")
    typer.echo(text)
    maps = {record.label: record.by_position for record in records}
    means = {record.label: record.mean for record in records}
    typer.echo(str(save_confidence(maps, means, out / f"{CONFIDENCE}.png")))
