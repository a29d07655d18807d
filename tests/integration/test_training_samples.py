"""What training shows of its networks: recorded clips above, the network's work below."""

from __future__ import annotations

import pytest
import torch

from controlmm.data import MotionFolder
from controlmm.ops import recover_joints
from controlmm.text.hashing import HashingTextEncoder
from controlmm.training.stages import train_stage

STAGES = ("rvq", "rvq-decoder", "masked", "residual", "control", "residual-control")
ROUNDING = 1e-4  # metres: the clips went through normalisation and back


@pytest.fixture(scope="module")
def shown(tiny_data_folder, tmp_path_factory):
    """The samples of every stage at both validations."""
    root = tmp_path_factory.mktemp("shown")
    collected = {}
    for stage in STAGES:
        seen = []
        train_stage(
            stage,
            data=tiny_data_folder,
            size="tiny",
            root=root,
            text_encoder=HashingTextEncoder(64),
            changes={"steps": 2, "validate_every": 1},
            progress=False,
            on_validation=lambda validation, seen=seen: seen.append(
                (validation.step, validation.samples(), validation.samples())
            ),
        )
        collected[stage] = seen
    return collected


@pytest.mark.parametrize("stage", STAGES)
def test_samples_are_validation_clips_beside_what_the_network_makes(shown, stage, tiny_data_folder):
    assert [step for step, *_ in shown[stage]] == [1, 2]
    clips = list(MotionFolder(tiny_data_folder).clips("val"))
    assert len(clips) == 4
    for _, samples, _ in shown[stage]:
        for sample, clip in zip(samples, (clips[0], clips[2], clips[3]), strict=True):  # spread evenly
            whole_tokens = clip.features[None, : len(clip.features) // 4 * 4]
            expected = recover_joints(whole_tokens, joints=22)[0]
            torch.testing.assert_close(sample.recorded, expected, rtol=0, atol=ROUNDING)
            assert sample.title.startswith(clip.captions[0].text)
            assert sample.made.shape == sample.recorded.shape
            assert torch.isfinite(sample.made).all()


@pytest.mark.parametrize("stage", STAGES)
def test_the_same_weights_make_the_same_samples(shown, stage):
    for _, first, second in shown[stage]:
        for a, b in zip(first, second, strict=True):
            assert torch.equal(a.made, b.made)
