"""``controlmm evaluate`` on the tiny model."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from controlmm.cli.interruption import INTERRUPTED
from controlmm.cli.main import app


@pytest.fixture
def arguments(
    tiny_data_folder: Path, tiny_evaluator_folder: Path, tiny_pipeline_folder: Path, tmp_path: Path
) -> list[object]:
    return [
        "evaluate", "--data", tiny_data_folder, "--evaluator", tiny_evaluator_folder,
        "--model", tiny_pipeline_folder, "--out", tmp_path / "out", "--quiet",
    ]  # fmt: skip


def test_it_prints_and_writes_tables_with_real_motion_first(
    command: Callable[..., str], arguments: list[object], tmp_path: Path
) -> None:
    printed = command(*arguments, "--control", "cross", "--density", "5", "--preset", "fast")
    assert (tmp_path / "out" / "results.md").read_text() + "\n" == printed
    lines = [line for line in printed.splitlines() if line.startswith("| real motion") or "fast" in line]
    assert any(line.startswith("| real motion |") for line in lines)
    assert any(line.startswith("| pipeline, fast |") for line in lines)
    assert "- captions: annotator, written, kinematic" in printed
    assert "- clips: 2 a repeat of 2 in the split test (synthetic 2)" in printed
    assert "| pipeline, perplexity of 32 |" in printed
    rows = json.loads((tmp_path / "out" / "results.json").read_text())["rows"]
    assert rows[2]["metrics"]["keys"]["mean"] >= 5


def test_the_same_command_computes_nothing_again(
    command: Callable[..., str], arguments: list[object], tmp_path: Path
) -> None:
    command(*arguments, "--preset", "fast")
    files = {file: file.stat().st_mtime_ns for file in (tmp_path / "out").rglob("*.safetensors")}
    command(*arguments, "--preset", "fast")
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "out").rglob("*.safetensors")} == files


def test_both_systems_are_measured_on_the_same_clips_and_targets(
    command: Callable[..., str], arguments: list[object], tiny_tlcontrol_folder: Path, tmp_path: Path
) -> None:
    printed = command(*arguments, "--model", tiny_tlcontrol_folder, "--control", "cross", "--preset", "fast")
    rows = json.loads((tmp_path / "out" / "results.json").read_text())["rows"]
    labels = [row["label"] for row in rows]
    assert labels == [
        "real motion",
        "pipeline, reconstruction",
        "pipeline, fast",
        "tlcontrol, reconstruction",
        "tlcontrol, fast",
    ]
    assert len({row["metrics"]["keys"]["mean"] for row in rows}) == 1
    assert "| tlcontrol, perplexity of " in printed


def test_ctrl_c_says_how_to_go_on(
    arguments: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("controlmm.evaluation.motion_sources.Generated.motions", stopped)
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == INTERRUPTED
    said = f"Stopped. The same command goes on in {tmp_path / 'out'}; at most one batch is lost."
    assert said in result.stderr
    assert len(list((tmp_path / "out").rglob("*.safetensors"))) == 2  # real motion and reconstruction


def test_two_models_need_two_names(
    refused: Callable[..., str], arguments: list[object], tiny_pipeline_folder: Path
) -> None:
    message = refused(*arguments, "--model", tiny_pipeline_folder)
    assert "Model folders must have different names, got pipeline, pipeline" in message


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--control", "tail"], "`control` must be a joint"),
        (["--density", "3"], "`density` must be one of 1, 2, 5, 49, 196 or all"),
        (["--preset", "best"], "Unknown `preset` 'best'"),
        (["--split", "dev"], "No list of the split 'dev'"),
        (["--captions", "sung"], "No clip in the split 'test'"),
        (["--repeats", "0"], "`repeats` must be at least 1"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_runs(
    refused: Callable[..., str], arguments: list[object], tmp_path: Path, extra: list[str], message: str
) -> None:
    assert message in refused(*arguments, *extra)
    assert not (tmp_path / "out").exists()
