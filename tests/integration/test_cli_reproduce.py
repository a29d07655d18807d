"""``controlmm reproduce`` on the tiny model: tables, pictures, resuming, refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from controlmm.evaluation.published_tables import published_table
from controlmm.pipelines import PRESETS

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
    [("tl-table3", 2, 2), ("tl-fig7", 0, 12)],
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
