"""Settings, the loop and the run folder, with a recipe of one linear layer."""

from __future__ import annotations

import json
import math
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file
from torch import nn

import controlmm
from controlmm.nn.checkpoint import PretrainedModel
from controlmm.training import provenance
from controlmm.training.averaging import WeightAverage
from controlmm.training.loop import train
from controlmm.training.processes import Processes
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
    ("changes", "message"),
    [
        ({"steps": 0}, "`steps` must be at least 1, got 0"),
        ({"batch_size": 0}, "must be at least 1"),
        ({"shards": 0}, "must be at least 1"),
        ({"validate_every": 0}, "must be at least 1"),
        ({"learning_rate": 0.0}, r"`learning_rate` must be positive, got 0\.0"),
        ({"patience": -1}, r"`patience` must be 0 \(never\) or a number of validations, got -1"),
        ({"average_decay": 1.0}, r"`average_decay` must be in \[0, 1\), such as 0\.999, got 1\.0"),
    ],
)
def test_impossible_settings_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
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


AVERAGED = replace(SETTINGS, average_decay=0.9, patience=3, shards=2)


@pytest.mark.parametrize("stop_at", [10, 20])
@pytest.mark.parametrize("settings", [SETTINGS, AVERAGED], ids=["plain", "averaged"])
def test_a_stopped_and_resumed_run_equals_an_unbroken_one_bit_by_bit(tmp_path, stop_at, settings):
    unbroken, resumed = tmp_path / "unbroken", tmp_path / "resumed"
    expected = fit(LineRecipe(), unbroken, settings).state_dict()

    def stop(step):
        if step == stop_at:  # after the validation, before the checkpoint of this step
            raise StoppedError

    with pytest.raises(StoppedError):
        fit(LineRecipe(), resumed, settings, on_validation=stop)
    recipe = LineRecipe()
    actual = fit(recipe, resumed, settings).state_dict()
    assert recipe.calls == settings.shards * (SETTINGS.steps - (stop_at - SETTINGS.checkpoint_every))
    assert all(torch.equal(actual[name], expected[name]) for name in expected)
    for name in ("checkpoint.safetensors", "best/model.safetensors"):
        first, second = load_file(unbroken / name), load_file(resumed / name)
        assert first.keys() == second.keys()
        assert all(torch.equal(first[key], second[key]) for key in first)
    assert any(name.startswith("average.") for name in load_file(unbroken / "checkpoint.safetensors")) == (
        settings is AVERAGED
    )
    assert RunFolder(resumed).records() == RunFolder(unbroken).records()


@pytest.mark.parametrize("does_write", [False, True], ids=["before", "after"])
def test_a_kill_between_any_two_writes_loses_nothing(tmp_path, monkeypatch, does_write):
    """Ends the run at each of its file replacements in turn; the resumed run is the unbroken one."""
    settings = replace(AVERAGED, steps=10, validate_every=5, checkpoint_every=5, patience=0)
    replace_file, calls = Path.replace, []

    def counted(self, target):
        calls.append(target)
        return replace_file(self, target)

    monkeypatch.setattr(Path, "replace", counted)
    fit(LineRecipe(), tmp_path / "unbroken", settings)
    expected = load_file(tmp_path / "unbroken" / "checkpoint.safetensors")
    assert len(calls) == 7  # settings, emptied log, twice best and checkpoint, summary
    for kill in range(len(calls)):
        run, left = tmp_path / f"killed{kill}", [kill]

        def killed(self, target, left=left):
            left[0] -= 1
            if left[0] == -1 and not does_write:
                raise StoppedError
            result = replace_file(self, target)
            if left[0] == -1:
                raise StoppedError
            return result

        monkeypatch.setattr(Path, "replace", killed)
        with pytest.raises(StoppedError):
            fit(LineRecipe(), run, settings)
        fit(LineRecipe(), run, settings)
        actual = load_file(run / "checkpoint.safetensors")
        assert all(torch.equal(actual[name], expected[name]) for name in expected), kill
        best, right = (load_file(r / "best" / "model.safetensors") for r in (run, tmp_path / "unbroken"))
        assert all(torch.equal(best[name], right[name]) for name in right), kill
        assert RunFolder(run).records() == RunFolder(tmp_path / "unbroken").records(), kill
        assert (run / "summary.json").is_file()


def test_a_finished_run_takes_no_more_steps(tmp_path):
    fit(LineRecipe(), tmp_path)
    recipe = LineRecipe()
    fit(recipe, tmp_path)
    assert recipe.calls == 0


def test_a_run_with_other_settings_is_refused(tmp_path):
    fit(LineRecipe(), tmp_path)
    with pytest.raises(
        ValueError,
        match=r"other settings: settings\.seed \(3407 before, 1 now\)\. Resume it with the same ones",
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
    assert _progress(tmp_path)["step"] == 10  # steps 15 to 30 were bad


def test_nineteen_bad_steps_do_not_end_the_run(tmp_path):
    recipe = LineRecipe(break_at=5, breaks=19)
    fit(recipe, tmp_path)
    assert recipe.calls == SETTINGS.steps


def test_a_score_that_is_no_number_is_never_the_best(tmp_path):
    fit(LineRecipe(scores=[math.nan, 3.0, math.nan, 4.0]), tmp_path)
    progress = _progress(tmp_path)
    assert (progress["step"], progress["best"], progress["best_step"], progress["stale"]) == (40, 3.0, 20, 2)


def _progress(run):
    with safe_open(run / "checkpoint.safetensors", framework="pt") as file:
        return json.loads(file.metadata()["progress"])


def test_gradients_are_clipped(tmp_path):
    settings = replace(SETTINGS, steps=10, clip_norm=1e-3, validate_every=10)
    fit(LineRecipe(), tmp_path, settings)
    (record,) = [record for record in RunFolder(tmp_path).records() if "gradient_norm" in record]
    assert record["gradient_norm"] > 1e-3  # the norm before clipping is logged


def test_the_average_of_the_weights_is_what_the_formula_says():
    """Decay min(0.9, (1 + n) / (10 + n)) before update n: 0.1, 2/11, 3/12, ..."""
    model = nn.Linear(1, 1, bias=False)
    average = WeightAverage(model, 0.9)
    expected, values = model.weight.item(), [3.0, -1.0, 2.0]
    for n, value in enumerate(values):
        model.weight.data.fill_(value)
        average.update()
        decay = min(0.9, (1 + n) / (10 + n))
        expected = decay * expected + (1 - decay) * value
    with average.applied():
        assert model.weight.item() == pytest.approx(expected, rel=1e-6)
    assert model.weight.item() == values[-1]


def test_averaged_weights_are_validated_and_kept(tmp_path):
    """A rate so high that the weights jump about: their average lies nearer to the truth."""
    settings = replace(SETTINGS, learning_rate=0.3, steps=60, warmup=0, milestones=(1000,))
    seen = []
    recipe = LineRecipe()
    fit(
        recipe, tmp_path / "averaged", replace(settings, average_decay=0.95),
        on_validation=lambda step: seen.append(recipe.model.layer.weight.clone()),
    )  # fmt: skip
    scores = [r["val_score"] for r in RunFolder(tmp_path / "averaged").records() if "val_score" in r]
    for weight, score in zip(seen, scores, strict=True):
        assert (weight - 1).abs().sum().item() == pytest.approx(score, abs=1e-5)
    best = Line.from_pretrained(tmp_path / "averaged" / "best").layer.weight
    assert (best - 1).abs().sum().item() == pytest.approx(min(scores), abs=1e-5)
    last = load_file(tmp_path / "averaged" / "checkpoint.safetensors")
    assert torch.equal(last["model.layer.weight"], recipe.model.layer.weight)  # the run goes on with its own
    assert torch.equal(last["average.layer.weight"], seen[-1])
    assert not torch.equal(seen[-1], recipe.model.layer.weight)


def test_a_run_without_a_better_score_ends_early_and_says_so(tmp_path):
    recipe = LineRecipe(scores=[3.0, 2.0, 2.5, 2.0])
    fit(recipe, tmp_path, replace(SETTINGS, steps=400, patience=2))
    assert recipe.calls == 40
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["ended"] == "early, no better validation score"
    assert (summary["steps"], summary["best_step"], summary["best_score"]) == (40, 20, 2.0)
    fit(recipe, tmp_path, replace(SETTINGS, steps=400, patience=2))
    assert recipe.calls == 40  # and stays ended


def test_two_shards_are_one_step_of_their_mean_gradient(tmp_path):
    """Shard k of step 0 is drawn from its own seed; one step is AdamW on the mean of both gradients."""
    settings = replace(SETTINGS, steps=1, shards=2, clip_norm=0.0, warmup=0, milestones=(9,))
    trained = fit(LineRecipe(), tmp_path, settings)
    recipe = LineRecipe()
    recipe.model.train()
    optimizer = torch.optim.AdamW(
        recipe.model.parameters(), lr=settings.learning_rate, betas=settings.betas, weight_decay=0.0
    )
    for shard in range(2):
        torch.manual_seed(settings.seed * 1_000_003 + shard * 1_000_000_007)
        (recipe.loss(4)["loss"] / 2).backward()
    optimizer.step()
    torch.testing.assert_close(trained.layer.weight, recipe.model.layer.weight, rtol=1e-6, atol=1e-7)


def test_shards_that_cannot_be_shared_are_refused(tmp_path):
    with pytest.raises(ValueError, match="`shards` must be a multiple of the 2 processes, got 3"):
        fit(LineRecipe(), tmp_path, replace(SETTINGS, shards=3), processes=Processes(0, 2))


def test_the_folder_says_where_the_run_comes_from(tmp_path):
    fit(LineRecipe(), tmp_path, files={"clips.tsv": "split\tid\n"})
    fit(LineRecipe(), tmp_path)
    first, _ = (json.loads(line) for line in (tmp_path / "starts.jsonl").read_text().splitlines())
    assert first.keys() >= {"time", "command", "version", "revision", "torch", "device", "processes"}
    assert first["version"] == controlmm.__version__
    assert json.loads((tmp_path / "run.json").read_text())["network"] == {"inputs": 3}
    assert (tmp_path / "clips.tsv").read_text() == "split\tid\n"


def test_the_revision_is_that_of_the_checkout_and_of_no_other_repository(tmp_path, monkeypatch):
    root = Path(__file__).resolve().parents[2]
    source = root / "python" / "controlmm" / "training" / "provenance.py"
    if not ((root / ".git").exists() and Path(provenance.__file__) == source):
        pytest.skip("the package does not run from a git checkout")
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=root, capture_output=True, text=True, check=True)
    assert provenance.git_revision().removesuffix("-dirty") == head.stdout.strip()
    subprocess.run(["git", "init", "-q", tmp_path], check=True)
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "provenance.py"))
    assert provenance.git_revision() is None


def test_a_run_from_before_a_setting_existed_is_resumed(tmp_path):
    fit(LineRecipe(), tmp_path)
    told = json.loads((tmp_path / "run.json").read_text())
    del told["settings"]["patience"], told["settings"]["average_decay"], told["network"]
    (tmp_path / "run.json").write_text(json.dumps(told))
    recipe = LineRecipe()
    fit(recipe, tmp_path)
    assert recipe.calls == 0
    with pytest.raises(ValueError, match=r"other settings: settings\.patience \(0 before, 4 now\)"):
        fit(recipe, tmp_path, replace(SETTINGS, patience=4))
