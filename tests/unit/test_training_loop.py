"""Settings, the loop and the run folder, with a recipe of one linear layer."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
import torch
from safetensors.torch import load_file
from torch import nn

from controlmm.nn.checkpoint import PretrainedModel
from controlmm.training.loop import train
from controlmm.training.run_folder import RunFolder
from controlmm.training.settings import TrainingSettings

SETTINGS = TrainingSettings(
    steps=40, batch_size=4, learning_rate=0.05, warmup=2, validate_every=10, checkpoint_every=5, bf16=False
)


@dataclass(frozen=True)
class LineConfig:
    """A line."""

    inputs: int = 3


class Line(PretrainedModel):
    """A linear layer with dropout, so that random numbers matter."""

    config_class: ClassVar[type] = LineConfig

    def __init__(self, config: LineConfig) -> None:
        super().__init__(config)
        self.layer = nn.Linear(config.inputs, 1)
        self.dropout = nn.Dropout(0.2)


class LineRecipe:
    """Fits sums; gradients are NaN from call ``break_at`` on, scores are ``scores`` in turn."""

    def __init__(self, *, break_at: int | None = None, breaks: int = 10**6, scores=()):
        torch.manual_seed(0)
        self.model = Line(LineConfig())
        self.calls, self.break_at, self.breaks = 0, break_at, breaks
        self.scores = list(scores)

    def loss(self, batch_size):
        self.calls += 1
        x = torch.randn(batch_size, 3)
        loss = (self.model.layer(self.model.dropout(x)) - x.sum(1, keepdim=True)).square().mean()
        if self.break_at is not None and self.break_at <= self.calls < self.break_at + self.breaks:
            loss = loss * math.nan
        return {"loss": loss}

    def validate(self):
        return {
            "score": self.scores.pop(0) if self.scores else self.model.layer.weight.sub(1).abs().sum().item()
        }

    def describe(self):
        return {"stage": "line"}


def fit(recipe, run, settings=SETTINGS, **options):
    return train(recipe, settings, run, progress=False, **options)


def test_warm_up_and_milestones_follow_the_published_schedule():
    settings = replace(SETTINGS, learning_rate=2e-4, warmup=2000, milestones=(50_000,), steps=180_000)
    # 1-based iteration i < 2000: lr (i + 1) / 2001, then lr, then a tenth of it
    for iteration, rate in (
        (1, 2e-4 * 2 / 2001),
        (1000, 2e-4 * 1001 / 2001),
        (2000, 2e-4),
        (50_000, 2e-4),
        (50_001, 2e-5),
    ):
        assert settings.learning_rate_at(iteration - 1) == pytest.approx(rate, rel=1e-12)


def test_without_milestones_the_rate_falls_by_a_cosine_to_a_hundredth():
    settings = replace(SETTINGS, learning_rate=1.0, warmup=10, steps=110)
    assert settings.learning_rate_at(10) == 1.0
    assert settings.learning_rate_at(60) == pytest.approx(0.505)
    assert settings.learning_rate_at(110) == pytest.approx(0.01)
    rates = [settings.learning_rate_at(step) for step in range(10, 110)]
    assert rates == sorted(rates, reverse=True)


@pytest.mark.parametrize(
    "changes", [{"steps": 0}, {"batch_size": 0}, {"learning_rate": 0.0}, {"validate_every": 0}]
)
def test_impossible_settings_are_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes)) if "rate" in str(changes) else "at least 1"):
        replace(SETTINGS, **changes)


def test_training_learns_and_keeps_the_best_weights(tmp_path):
    fit(LineRecipe(), tmp_path)
    records = RunFolder(tmp_path).records()
    losses = [record["loss"] for record in records if "loss" in record]
    scores = [record["val_score"] for record in records if "val_score" in record]
    assert len(losses) == len(scores) == 4
    assert scores[-1] < scores[0]
    best = Line.from_pretrained(tmp_path / "best").layer.weight
    assert (best - 1).abs().sum().item() == pytest.approx(min(scores), abs=1e-5)


class StoppedError(Exception):
    """The kill."""


@pytest.mark.parametrize("stop_at", [10, 20])
def test_a_stopped_and_resumed_run_equals_an_unbroken_one_bit_by_bit(tmp_path, stop_at):
    unbroken, resumed = tmp_path / "unbroken", tmp_path / "resumed"
    expected = fit(LineRecipe(), unbroken).state_dict()

    def stop(step):
        if step == stop_at:  # after the validation, before the checkpoint of this step
            raise StoppedError

    with pytest.raises(StoppedError):
        fit(LineRecipe(), resumed, on_validation=stop)
    recipe = LineRecipe()
    actual = fit(recipe, resumed).state_dict()
    assert recipe.calls == SETTINGS.steps - (stop_at - SETTINGS.checkpoint_every)
    assert all(torch.equal(actual[name], expected[name]) for name in expected)
    for name in ("checkpoint.safetensors", "best/model.safetensors"):
        first, second = load_file(unbroken / name), load_file(resumed / name)
        assert all(torch.equal(first[key], second[key]) for key in first)
    assert RunFolder(resumed).records() == RunFolder(unbroken).records()


def test_a_finished_run_takes_no_more_steps(tmp_path):
    fit(LineRecipe(), tmp_path)
    recipe = LineRecipe()
    fit(recipe, tmp_path)
    assert recipe.calls == 0


def test_a_run_with_other_settings_is_refused(tmp_path):
    fit(LineRecipe(), tmp_path)
    with pytest.raises(
        ValueError, match=r"holds a run with another settings\. Resume it with the same settings"
    ):
        fit(LineRecipe(), tmp_path, replace(SETTINGS, seed=1))


@pytest.mark.parametrize("keep", [0, 10, -10])
def test_a_damaged_checkpoint_is_named(tmp_path, keep):
    fit(LineRecipe(), tmp_path)
    file = tmp_path / "checkpoint.safetensors"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(ValueError, match=r"checkpoint\.safetensors is damaged or belongs to another network"):
        fit(LineRecipe(), tmp_path)


def test_a_foreign_file_as_checkpoint_is_named(tmp_path):
    fit(LineRecipe(), tmp_path)
    (tmp_path / "best" / "model.safetensors").replace(tmp_path / "checkpoint.safetensors")
    with pytest.raises(ValueError, match=r"checkpoint\.safetensors is damaged or belongs to another network"):
        fit(LineRecipe(), tmp_path)


def test_damaged_settings_are_named(tmp_path):
    fit(LineRecipe(), tmp_path)
    (tmp_path / "run.json").write_text('{"settings":')
    with pytest.raises(ValueError, match=r"run\.json is damaged"):
        fit(LineRecipe(), tmp_path)


def test_a_log_line_cut_short_by_a_kill_is_left_out(tmp_path):
    folder = RunFolder(tmp_path)
    folder.write_settings({})
    folder.log({"step": 10, "loss": 0.1234567})
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 20, "lo')
    assert folder.records() == [{"step": 10, "loss": 0.123457}]
    folder.forget_after(5)
    assert folder.records() == []


def test_steps_without_a_finite_gradient_are_left_out(tmp_path, caplog):
    broken, skipped = LineRecipe(break_at=3, breaks=1), LineRecipe()
    settings = replace(SETTINGS, steps=3)
    fit(broken, tmp_path / "a", settings)
    fit(skipped, tmp_path / "b", replace(settings, steps=2, checkpoint_every=1))
    assert "Step 3: the gradient is not finite" in caplog.text
    # warm-up over two steps: the rates of steps 1 and 2 do not depend on the number of steps
    assert torch.equal(broken.model.layer.weight, skipped.model.layer.weight)


def test_twenty_bad_steps_in_a_row_end_the_run_and_keep_the_good_checkpoint(tmp_path):
    recipe = LineRecipe(break_at=14)
    with pytest.raises(ValueError, match="not finite for 20 steps up to step 33"):
        fit(recipe, tmp_path)
    assert recipe.calls == 33
    model = LineRecipe().model
    optimizer = torch.optim.AdamW(model.parameters())
    step, _ = RunFolder(tmp_path).load_checkpoint(model, optimizer)
    assert step == 10  # steps 15 to 30 were bad


def test_nineteen_bad_steps_do_not_end_the_run(tmp_path):
    recipe = LineRecipe(break_at=5, breaks=19)
    fit(recipe, tmp_path)
    assert recipe.calls == SETTINGS.steps


def test_a_score_that_is_no_number_is_never_the_best(tmp_path):
    fit(LineRecipe(scores=[math.nan, 3.0, math.nan, 4.0]), tmp_path)
    metadata = json.loads(_metadata(tmp_path / "checkpoint.safetensors")["progress"])
    assert metadata == {"step": 40, "best": 3.0}


def _metadata(path):
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        return file.metadata()


def test_gradients_are_clipped(tmp_path):
    settings = replace(SETTINGS, steps=10, clip_norm=1e-3, validate_every=10)
    fit(LineRecipe(), tmp_path, settings)
    (record,) = [record for record in RunFolder(tmp_path).records() if "gradient_norm" in record]
    assert record["gradient_norm"] > 1e-3  # the norm before clipping is logged
