"""KIT-ML's layout (21 joints, 251 features, millimetres) through every stage, mask and network."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from controlmm.controls import JointControl
from controlmm.data import Caption, Clip, write_folder
from controlmm.models.control_branch import ControlBranch
from controlmm.models.masked_transformer import MaskedTransformer
from controlmm.models.residual_control import ResidualControl
from controlmm.models.residual_transformer import ResidualTransformer
from controlmm.motion.skeleton import KIT
from controlmm.pipelines import ControlMM
from controlmm.text.hashing import HashingTextEncoder
from controlmm.training.run_folder import RunFolder
from controlmm.training.stage import load_tokenizer
from controlmm.training.stages import train_stage

STAGES = ("rvq", "masked", "residual", "control", "residual-control")
FRAMES, STILL = 70, 10
BONE = 90.0  # millimetres


def kit_joints(seed: int) -> torch.Tensor:
    """(70, 21, 3) millimetres: the rest pose on a straight way, every joint wobbling by a few centimetres."""
    random = np.random.default_rng(seed)
    pose = np.zeros((21, 3))
    for joint, parent in enumerate(KIT.parents[1:], start=1):
        pose[joint] = pose[parent] + BONE * np.array(KIT.directions[joint]) + random.normal(0, 5, 3)
    time = np.arange(FRAMES)[:, None, None] / KIT.fps
    way = time * np.array([random.uniform(-100, 100), 0, random.uniform(200, 600)])
    rates, phases = random.uniform(1, 6, (1, 21, 3)), random.uniform(0, 6, (1, 21, 3))
    joints = pose - [0, pose[:, 1].min(), 0] + way + 15 * np.sin(rates * time + phases)
    joints[:STILL] = joints[STILL]  # KIT's contact threshold calls only a foot at rest a contact
    return torch.from_numpy(joints)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kit")
    clips = [
        Clip(
            id=f"{split}{index}",
            joints=kit_joints(10 * index + len(split)),
            captions=(Caption("a person walks", "annotator"),),
            source="synthetic",
            licence="CC0-1.0",
            split=split,
        )
        for split, count in (("train", 3), ("val", 2))
        for index in range(count)
    ]
    write_folder(clips, folder, progress=False)
    return folder


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    root = tmp_path_factory.mktemp("trained")
    for stage in STAGES:
        train_stage(
            stage,
            data=data,
            size="tiny",
            root=root,
            text_encoder=HashingTextEncoder(64),
            changes={"steps": 6, "validate_every": 3},
            progress=False,
        )
    return root


def test_every_stage_trains(trained):
    tokenizer, normalizer = load_tokenizer(trained)
    assert (tokenizer.config.feature_dim, normalizer.skeleton.name) == (251, "kit")
    for stage in STAGES:
        records = RunFolder(trained / stage).records()
        assert all(torch.isfinite(torch.tensor(list(record.values()))).all() for record in records)


def test_the_control_signal_and_its_loss_are_in_metres(trained):
    """Millimetres would give errors of hundreds beside a cross-entropy of a few units."""
    branch = ControlBranch.from_pretrained(trained / "control" / "best")
    assert branch.config.signal_scale == 0.001
    assert branch.config.joints == tuple(range(21))
    points = torch.full((1, 4, 21, 3), 500.0)
    signal = branch.signal(points, torch.ones_like(points, dtype=torch.bool), torch.zeros_like(points))
    assert signal.max().item() == 1.0  # the mask; half a metre elsewhere
    assert all(record.get("val_consistency", 0) < 3 for record in RunFolder(trained / "control").records())


def test_the_trained_parts_make_a_pipeline_that_is_controlled(trained):
    tokenizer, normalizer = load_tokenizer(trained)
    pipeline = ControlMM(
        tokenizer=tokenizer,
        normalizer=normalizer,
        transformer=MaskedTransformer.from_pretrained(trained / "masked" / "best"),
        residual=ResidualTransformer.from_pretrained(trained / "residual" / "best"),
        control=branch_of(trained),
        residual_control=ResidualControl.from_pretrained(trained / "residual-control" / "best"),
        text_encoder=HashingTextEncoder(64),
    )
    control = JointControl("LW", frames=[4, 20], positions=[[50, 500, 0], [50, 500, 300]])
    result = pipeline("a person walks", frames=24, controls=[control], preset="fast")
    assert result.best.joints.shape == (24, 21, 3)
    assert torch.isfinite(result.best.joints).all()


def branch_of(root):
    return ControlBranch.from_pretrained(root / "control" / "best")


@pytest.mark.parametrize("masks", ["trajectory", "random", "cross", "mixed"])
def test_every_kind_of_mask_names_kits_joints(masks):
    from controlmm.training.control_masks import sample_masks

    torch.manual_seed(0)
    frames = torch.ones(60, 24, dtype=torch.bool)
    mask = sample_masks(masks, frames, joints=21, among=KIT.control_joints)
    assert mask.shape == (60, 24, 21, 3)
    named = set(mask.any(-1).flatten(0, 1).any(0).nonzero()[:, 0].tolist())
    expected = {"trajectory": {0}, "mixed": set(range(21))}.get(masks, set(KIT.control_joints))
    assert named == expected
