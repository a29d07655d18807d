"""The table of editing on a tiny model: its rows exist, mean what they say, and are kept."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from benchmarks import editing, editing_rows
from benchmarks.editing_rows import PLANS, REAL, Bench

from controlmm.evaluation.control_draws import ControlSetting
from controlmm.evaluation.evaluators import load_evaluator
from controlmm.evaluation.protocol import Protocol
from controlmm.evaluation.test_set import read_test_set


@pytest.fixture
def bench(tiny_pipeline, tiny_data_folder, tiny_evaluator_folder, monkeypatch):
    quick = {
        name: replace(
            plan,
            steps=2,
            budget=replace(
                plan.budget,
                logits_iterations=min(1, plan.budget.logits_iterations),
                latent_iterations=min(20, plan.budget.latent_iterations),
            ),
        )
        for name, plan in PLANS.items()
    }
    monkeypatch.setattr(editing_rows, "PLANS", quick)
    test_set = read_test_set(tiny_data_folder, split="val")
    return Bench(
        tiny_pipeline, load_evaluator(tiny_evaluator_folder), test_set, Protocol(limit=2), slow_limit=1
    )


@torch.no_grad()
def test_editing_lowers_the_error_and_counts_its_work(bench):
    setting = ControlSetting("left_wrist", 2)
    rows = {solver: bench.row(solver, setting) for solver in (REAL, *PLANS)}
    assert rows[REAL]["error_cm"] == 0
    assert rows["unedited"]["evaluations"] == 0
    for solver in ("gauss-newton", "exact", "lbfgs"):
        assert rows[solver]["error_cm"] < rows["unedited"]["error_cm"]
        assert 1 <= rows[solver]["evaluations"] <= 120
        assert rows[solver]["seconds"] > 0
    assert max(rows[solver]["worst_cm"] for solver in ("gauss-newton", "exact", "lbfgs")) < 0.01
    assert rows["latents alone"]["worst_cm"] > 0.01
    assert rows["latents alone"]["worth"] > 1
    assert rows["paper-accurate"]["evaluations"] == 2 + 21  # logits in two steps, latents with the start


@torch.no_grad()
def test_slow_solvers_take_fewer_clips_and_few_clips_have_no_fid(bench):
    rows = {solver: bench.row(solver, ControlSetting("pelvis", 1)) for solver in ("exact", "paper-accurate")}
    assert (rows["exact"]["clips"], rows["paper-accurate"]["clips"]) == (2, 1)
    text = editing.table([{**row, "key": f"{solver}/pelvis/1"} for solver, row in rows.items()])
    assert math.isnan(rows["exact"]["fid"])
    assert "nan" not in text


def test_what_takes_hours_comes_last():
    keys = editing.keys_of(["paper-accurate", "exact", "lbfgs"], ["pelvis", "cross"], [1, 196])
    assert keys[0] == f"{REAL}/pelvis/1"
    assert keys[1:3] == ["exact/pelvis/1", "lbfgs/pelvis/1"]
    assert keys[-1] == "paper-accurate/cross/196"
    assert len(keys) == 1 + 3 * 4


def test_tables_have_means_and_a_part_for_every_joint():
    row = dict.fromkeys((name for name, _ in editing._COLUMNS.values()), 1.0)
    rows = [
        {**row, "key": f"{REAL}/pelvis/1"},
        {**row, "key": "exact/pelvis/1", "error_cm": 2.0},
        {**row, "key": "exact/pelvis/196", "error_cm": 4.0},
    ]
    text = editing.table(rows)
    assert "| all | exact | 3.000 |" in text
    assert "| 100 % | exact | 4.000 |" in text
    assert text.count("## ") == 2
