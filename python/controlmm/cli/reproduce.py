"""``controlmm reproduce``: a paper's table with our rows beneath the published ones, or all of them."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controlmm.cli.evaluate import KINDS, facts_of, listed
from controlmm.cli.interruption import resumable
from controlmm.cli.output_folder import writable_folder

if TYPE_CHECKING:
    from controlmm.evaluation.controlmm_tables import Study
    from controlmm.evaluation.evaluators import Evaluator
    from controlmm.evaluation.protocol import Protocol
    from controlmm.evaluation.reproduction import Reproduction
    from controlmm.evaluation.scores import RowScores
    from controlmm.evaluation.test_set import TestSet
    from controlmm.evaluation.tlcontrol_tables import Duel

ALL = "all"
CONFIDENCE = "confidence"  # Figures 7 to 11
SUMMARY_FILE = "README.md"  # of `all`
_TABLES = (
    "table1 to table10, confidence (Figures 7 to 11); of TLControl: tl-table1 to tl-table4, tl-fig7, "
    "tl-supplement2; or all, every table of the data's skeleton in turn."
)


def reproduce(
    table: Annotated[str, typer.Argument(help=_TABLES)],
    data: Annotated[Path, typer.Option(help="HumanML3D folder, or a folder of npz packs.")],
    out: Annotated[
        Path,
        typer.Option(
            help="Folder; every table gets one in it. Tables share what they have in common, and the same "
            "command goes on.",
            callback=writable_folder,
        ),
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
    from controlmm.evaluation.evaluators import load_evaluator
    from controlmm.evaluation.protocol import Protocol
    from controlmm.evaluation.test_set import read_test_set

    protocol, presets = Protocol(repeats, limit, seed), tuple(preset or ())
    _check(table, presets)
    study = _study(model, effort, presets)
    names = _all_names(study) if table == ALL else [table]
    plans = _plans(names, study, tlcontrol)
    judge = load_evaluator(evaluator)
    test_set = read_test_set(data, kinds=listed(captions))
    seconds = {}
    for name in names:
        started = time.perf_counter()
        with resumable(out):
            if name == CONFIDENCE:
                _confidence(study, test_set, protocol, out)
            else:
                _table(plans[name], test_set, judge, protocol, effort, out, name, is_quiet=quiet)
        seconds[name] = time.perf_counter() - started
    if table == ALL:
        _summary(seconds, facts_of(test_set, protocol, seconds=sum(seconds.values())), out)


def _check(table: str, presets: tuple[str, ...]) -> None:
    from controlmm.evaluation.controlmm_tables import TABLES
    from controlmm.evaluation.tlcontrol_tables import TABLES as TL_TABLES
    from controlmm.pipelines.presets import preset_named

    known = (*TABLES, CONFIDENCE, *TL_TABLES, ALL)
    if table not in known:
        raise ValueError(f"Unknown table {table!r}. Tables: {', '.join(known)}.")
    for name in presets:
        preset_named(name)


def _study(model: Path | None, effort: float, presets: tuple[str, ...]) -> Study:
    from controlmm.evaluation.controlmm_tables import Study
    from controlmm.pipelines import ControlMM

    return Study(ControlMM.from_pretrained(model), effort, presets)


def _all_names(study: Study) -> list[str]:
    """Every table that is of the model's skeleton, in the order of the papers."""
    from controlmm.evaluation.controlmm_tables import KIT_TABLES, TABLES
    from controlmm.evaluation.tlcontrol_tables import KIT_TABLES as TL_KIT_TABLES
    from controlmm.evaluation.tlcontrol_tables import TABLES as TL_TABLES
    from controlmm.motion.skeleton import KIT

    of_kit = {*KIT_TABLES, *TL_KIT_TABLES}
    if study.pipeline.skeleton == KIT:
        return [name for name in (*TABLES, *TL_TABLES) if name in of_kit]
    return [name for name in (*TABLES, CONFIDENCE, *TL_TABLES) if name not in of_kit]


def _plans(names: list[str], study: Study, tlcontrol: Path | None) -> dict[str, Reproduction]:
    """What is to be evaluated for each table; TLControl is loaded only where it is needed."""
    from controlmm.evaluation.controlmm_tables import TABLES
    from controlmm.evaluation.tlcontrol_tables import TABLES as TL_TABLES

    plans = {name: TABLES[name](study) for name in names if name in TABLES}
    if any(name in TL_TABLES for name in names):
        duel = _duel(study, tlcontrol)
        plans |= {name: TL_TABLES[name](duel) for name in names if name in TL_TABLES}
    return plans


def _duel(study: Study, tlcontrol: Path | None) -> Duel:
    from controlmm.evaluation.tlcontrol_tables import Duel
    from controlmm.pipelines import TLControl

    return Duel(TLControl.from_pretrained(tlcontrol), study.pipeline, study.presets or ("balanced",))


def _table(
    plan: Reproduction,
    test_set: TestSet,
    judge: Evaluator,
    protocol: Protocol,
    effort: float,
    out: Path,
    name: str,
    *,
    is_quiet: bool,
) -> None:
    """Print a table; write it as Markdown, JSON and pictures into ``out/name``."""
    from controlmm.cli.result_pictures import save_pictures
    from controlmm.evaluation.protocol import evaluate_rows

    started = time.perf_counter()
    scores = evaluate_rows(plan.rows, test_set, judge, protocol, out, is_shared=True, progress=not is_quiet)
    facts = facts_of(test_set, protocol, seconds=time.perf_counter() - started)
    facts["editing iterations"] = "the paper's" if effort == 1 else f"{effort:g} of the paper's"
    folder = out / name
    _write(plan, scores, facts, judge.caution, folder)
    for picture in save_pictures(plan, scores, folder, effort=effort):
        typer.echo(str(picture))


def _write(
    plan: Reproduction, scores: list[RowScores], facts: dict[str, Any], caution: str, folder: Path
) -> None:
    from controlmm.evaluation.report import write_json

    folder.mkdir(parents=True, exist_ok=True)
    text = _page(f"{plan.name}: {plan.published.title}", facts, plan.markdown(scores), [*plan.notes, caution])
    (folder / f"{plan.name}.md").write_text(text, encoding="utf-8")
    rows = [score.as_json() for score in scores]
    write_json(folder / f"{plan.name}.json", {"table": plan.name, **facts, "caution": caution, "rows": rows})
    typer.echo(text)


def _page(title: str, facts: dict[str, Any], table: str, notes: list[str]) -> str:
    said = "\n".join(f"- {name}: {value}" for name, value in facts.items())
    parts = [f"# {title}", table, "\n".join(f"- {note}" for note in notes), said]
    return "\n\n".join(part for part in parts if part) + "\n"


def _confidence(study: Study, test_set: TestSet, protocol: Protocol, out: Path) -> None:
    """One batch of pelvis control at a quarter of the frames."""
    from controlmm.evaluation.confidence import confidence_records, mean_confidence
    from controlmm.evaluation.control_draws import ControlSetting
    from controlmm.evaluation.motion_sources import Batch
    from controlmm.evaluation.protocol import batches_of
    from controlmm.evaluation.report import pipe_table
    from controlmm.viewer.evaluation_charts import save_confidence

    started = time.perf_counter()
    samples, masks = zip(*next(batches_of(test_set, ControlSetting("pelvis", 49), protocol, 0)), strict=True)
    folder = out / CONFIDENCE
    batch = Batch.of(samples, masks, seed=protocol.seed, repeat=0)
    records = confidence_records(study.pipeline, batch, iterations=max(1, round(100 * study.effort)))
    steps = [str(step + 1) for step in range(len(records[0].mean))]
    table = pipe_table(["step", *steps], mean_confidence(records))
    facts = facts_of(test_set, protocol, seconds=time.perf_counter() - started)
    facts["clips"] = len(samples)
    text = _page("Confidence in each decoding step (Figures 7 to 11)", facts, table, [])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{CONFIDENCE}.md").write_text(text, encoding="utf-8")
    typer.echo(text)
    maps = {record.label: record.by_position for record in records}
    means = {record.label: record.mean for record in records}
    typer.echo(str(save_confidence(maps, means, folder / f"{CONFIDENCE}.png")))


def _summary(seconds: dict[str, float], facts: dict[str, object], out: Path) -> None:
    """Print which tables there are and how long each took in this call; write it beside them."""
    from controlmm.evaluation.report import pipe_table

    rows = [[f"[{name}]({name})", f"{took:.0f}"] for name, took in seconds.items()]
    notes = ["A table takes no time for rows that an earlier one, or an earlier call, has made."]
    text = _page("The papers' tables", dict(facts), pipe_table(["table", "s in this call"], rows), notes)
    (out / SUMMARY_FILE).write_text(text, encoding="utf-8")
    typer.echo(text)
