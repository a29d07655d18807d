"""Every stage trains on a device that is not the CPU: nothing that a step needs is made on the CPU."""

from __future__ import annotations

import pytest
import torch
from second_device import ELSEWHERE, moved, second_device
from torch import nn

from controlmm.data import MotionFolder
from controlmm.text.hashing import HashingTextEncoder
from controlmm.training.registry import MODULES, load_stage
from controlmm.training.stage import StageInputs
from controlmm.training.stages import train_stage


@pytest.fixture(scope="module")
def root(tiny_data_folder, tmp_path_factory):
    """The stages that others stand on, after one step."""
    root = tmp_path_factory.mktemp("root")
    for stage in ("rvq", "masked", "residual", "tl-vq"):
        train_stage(
            stage,
            data=tiny_data_folder,
            size="tiny",
            root=root,
            text_encoder=HashingTextEncoder(64),
            changes={"steps": 1, "validate_every": 1},
            progress=False,
        )
    return root


@pytest.fixture
def elsewhere(monkeypatch):
    """``model.to("meta")`` moves it to the second device."""
    to = nn.Module.to

    def goes(self, *args, **kwargs):
        return moved(self) if args and torch.device(args[0]) == ELSEWHERE else to(self, *args, **kwargs)

    monkeypatch.setattr(nn.Module, "to", goes)


def test_the_second_device_refuses_what_a_gpu_would():
    with second_device():
        there = torch.ones(3, device=ELSEWHERE)
        assert (there + 1).device == ELSEWHERE
        assert (there + 1).sum().item() == 6
        assert there.cpu().device.type == "cpu"
        with pytest.raises(RuntimeError, match="tensors of two devices"):
            there + torch.ones(3)


@pytest.mark.parametrize("name", MODULES)
def test_a_stage_takes_a_step_and_validates_elsewhere(name, root, tiny_data_folder, elsewhere):
    stage = load_stage(name)
    inputs = StageInputs(
        root,
        MotionFolder(tiny_data_folder),
        text_encoder=HashingTextEncoder(64),
        options=stage.options,
        progress=False,
        writes=False,
    )
    torch.manual_seed(0)
    recipe = stage.build(stage.configs["tiny"], inputs)
    recipe.model.to(ELSEWHERE)
    recipe.model.train()
    with second_device():
        loss = recipe.loss(2)["loss"]
        loss.backward()
        assert loss.device == ELSEWHERE
        gradients = [p.grad for p in recipe.model.parameters() if p.grad is not None]
        assert gradients
        assert all(gradient.device == ELSEWHERE for gradient in gradients)
        recipe.model.eval()
        with torch.no_grad():
            metrics = recipe.validate()
    assert all(torch.tensor(value).isfinite() for value in metrics.values()), metrics
