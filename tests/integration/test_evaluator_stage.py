"""The training stage ``evaluator`` on a tiny folder."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import load_file

from controlmm.models.motion_text_matcher import MotionTextMatcher
from controlmm.text.hashing import HashingTextEncoder
from controlmm.training.run_folder import RunFolder
from controlmm.training.stages import train_stage


def _train(data: Path, root: Path, *, steps: int) -> Path:
    return train_stage(
        "evaluator",
        data=data,
        size="tiny",
        root=root,
        text_encoder=HashingTextEncoder(64),
        changes={"steps": steps, "validate_every": 5, "checkpoint_every": 5},
        progress=False,
    )


def test_it_trains_without_any_other_stage_and_learns(tiny_data_folder: Path, tmp_path: Path) -> None:
    run = _train(tiny_data_folder, tmp_path, steps=20)
    records = RunFolder(run).records()
    scores = [record["val_loss"] for record in records if "val_loss" in record]
    assert scores[-1] < scores[0]
    matcher = MotionTextMatcher.from_pretrained(run / "best")
    assert matcher.config.text_encoder["kind"] == "hashing"
    assert not torch.equal(matcher.normalizer.mean, torch.zeros(263))


def test_the_same_seed_gives_the_same_weights(tiny_data_folder: Path, tmp_path: Path) -> None:
    first, second = (_train(tiny_data_folder, tmp_path / name, steps=5) for name in ("a", "b"))
    weights = [load_file(run / "best" / "model.safetensors") for run in (first, second)]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
