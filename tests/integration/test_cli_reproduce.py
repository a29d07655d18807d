"""``controlmm reproduce`` on the tiny model: tables, pictures, resuming, refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from controlmm.cli.reproduce import _all_names
from controlmm.evaluation.controlmm_tables import Study
from controlmm.evaluation.published_tables import published_table
from controlmm.pipelines import PRESETS, ControlMM

PNG = b"\x89PNG"


@pytest.fixture
def arguments(
    tiny_data_folder: Path, tiny_evaluator_folder: Path, tiny_pipeline_folder: Path, tmp_path: Path
) -> list[object]:
    return [
        "--data", tiny_data_folder, "--evaluator", tiny_evaluator_folder, "--model", tiny_pipeline_folder,
        "--out", tmp_path / "out", "--effort", "0.01", "--quiet",
    ]  # fmt: skip


# table: lines of ours, pictures
TABLES = {"table1": (9, []), "table5": (len(PRESETS), ["figure2.png"]), "table9": (6, ["table9.png"])}


@pytest.mark.parametrize("table", TABLES)
def test_our_lines_stand_under_all_published_ones(
    command: Callable[..., str], arguments: list[object], tmp_path: Path, table: str
) -> None:
    printed = command("reproduce", table, *arguments)
    lines = [line for line in printed.splitlines() if line.startswith("|")][2:]
    count, pictures = TABLES[table]
    published = len(published_table(table).rows)
    assert all("| published |" in line for line in lines[:published])
    assert len(lines[published:]) == count
    assert all("| ours |" in line for line in lines[published:])
    assert "never with published ones" in printed
    assert "- editing iterations: 0.01 of the paper's" in printed
    for picture in pictures:
        assert (tmp_path / "out" / table / picture).read_bytes().startswith(PNG)
    assert len(json.loads((tmp_path / "out" / table / f"{table}.json").read_text())["rows"]) >= count - 1


def test_components_of_the_time(command: Callable[..., str], arguments: list[object]) -> None:
    printed = command("reproduce", "table6", *arguments)
    assert "| 0.35 | 0.24 | 24.65 | 46.5 | 71.73 |" in printed
    titles = "| s a clip | base | motion control model | codebook editing | logits editing | full |"
    ours = printed.splitlines()[printed.splitlines().index(titles) + 2].strip("| ").split(" | ")
    base, model, codebook, logits, full = map(float, ours[1:])
    assert base + model + codebook + logits == pytest.approx(full, abs=0.03)  # each rounded to 0.01


def test_presets_of_ours_get_rows(command: Callable[..., str], arguments: list[object]) -> None:
    printed = command("reproduce", "table5", *arguments, "--preset", "fast")
    assert "| preset fast | ours |" in printed


def test_confidence_has_five_maps(
    command: Callable[..., str], arguments: list[object], tmp_path: Path
) -> None:
    printed = command("reproduce", "confidence", *arguments)
    lines = [line for line in printed.splitlines() if line.startswith("|")][2:]
    assert [line.split(" | ")[0].strip("| ") for line in lines] == [
        "text alone",
        "control model off, no editing",
        "control model off, logits editing",
        "control model on, no editing",
        "control model on, logits editing",
    ]
    assert all(0 <= float(cell) <= 1 for line in lines for cell in line.strip("| ").split(" | ")[1:])
    assert (tmp_path / "out" / "confidence" / "confidence.png").read_bytes().startswith(PNG)


@pytest.mark.parametrize(
    ("table", "published", "ours"),
    [("tl-table3", 2, 2), ("tl-fig7", 0, 12), ("tl-supplement2", 4, 8)],
)
def test_tables_of_tlcontrol_have_both_models(
    command: Callable[..., str],
    arguments: list[object],
    tiny_tlcontrol_folder: Path,
    tmp_path: Path,
    table: str,
    published: int,
    ours: int,
) -> None:
    printed = command(
        "reproduce", table, *arguments, "--tlcontrol", tiny_tlcontrol_folder, "--preset", "fast"
    )
    lines = [line for line in printed.splitlines() if line.startswith("|") and "---" not in line]
    tables = 1 + (table == "tl-table3")  # ours stands beside the published one
    assert len(lines) == published + ours + tables
    if table == "tl-fig7":
        assert (tmp_path / "out" / table / "tl-figure7.png").read_bytes().startswith(PNG)


@pytest.mark.parametrize(
    ("table", "extra", "message"),
    [
        ("table10", [], "table10 is of KIT-ML: pass a KIT-ML folder as `--data`"),
        ("table99", [], "Unknown table 'table99'. Tables: table1, table2"),
        ("table1", ["--effort", "0"], "`effort` must be above 0 and at most 1, got 0.0"),
        ("table5", ["--preset", "best"], "Unknown `preset` 'best'"),
    ],
)
def test_refusals(
    refused: Callable[..., str], arguments: list[object], table: str, extra: list[str], message: str
) -> None:
    assert message in refused("reproduce", table, *arguments, *extra)


def test_all_tables_share_what_they_have_in_common_and_say_how_long_they_took(
    command: Callable[..., str],
    arguments: list[object],
    tiny_tlcontrol_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    chosen = ["table3", "table5", "table8", "tl-table1", "tl-fig7"]
    monkeypatch.setattr("controlmm.cli.reproduce._all_names", lambda _: chosen)
    arguments += ["--tlcontrol", tiny_tlcontrol_folder, "--preset", "fast"]
    printed = command("reproduce", "all", *arguments)
    for name in chosen:
        assert f"| [{name}]({name}) | " in printed
        assert list((tmp_path / "out" / name).glob("*.md"))
    assert (tmp_path / "out" / "README.md").read_text() in printed
    kept = list((tmp_path / "out" / "batches").iterdir())
    # The paper's Accurate is in three tables, its Medium in two; all six whole paths in two, twice.
    assert len(kept) == 8 + (4 - 2) + (6 - 1) + 15 + (12 - 2)
    files = {file: file.stat().st_mtime_ns for file in (tmp_path / "out").rglob("*.safetensors")}
    command("reproduce", "table3", *arguments)
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "out").rglob("*.safetensors")} == files


def test_all_is_every_table_of_the_skeleton(tiny_pipeline: ControlMM) -> None:
    names = _all_names(Study(tiny_pipeline))
    assert len(names) == len(set(names)) == 9 + 1 + 5
    assert not {"table10", "tl-table2"} & set(names)


def test_incomplete_batches_of_other_limits_are_other_rows(
    command: Callable[..., str], arguments: list[object], tmp_path: Path
) -> None:
    command("reproduce", "table2", *arguments, "--limit", "1")
    command("reproduce", "table2", *arguments)  # two clips
    assert len(list((tmp_path / "out" / "batches").iterdir())) == 4
