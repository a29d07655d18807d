"""Bad input to the public call: each is refused with the argument's name before any network runs."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from controlmm.controls import JointControl
from controlmm.generation.editing import EditingBudget
from controlmm.models.control_branch import ControlBranch, ControlBranchConfig
from controlmm.models.residual_transformer import ResidualTransformer, ResidualTransformerConfig
from controlmm.models.rvq_vae import RvqVae, RvqVaeConfig
from controlmm.motion.normalizer import Normalizer
from controlmm.pipelines import PRESETS, ControlMM, Preset
from controlmm.text.hashing import HashingTextEncoder

PROMPT = "a person walks"


def control(frame: int = 0, joint: str = "pelvis", point=(0.0, 0.9, 0.0)) -> JointControl:
    return JointControl(joint, [frame], [list(point)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"prompt": ""}, "`prompt` is empty"),
        ({"prompt": "  \n"}, "`prompt` is empty"),
        ({"prompt": None}, "`prompt` must be a string, got NoneType"),
        ({"seconds": 2, "frames": 40}, r"Pass `seconds` or `frames`, not both \(got 2 and 40\)"),
        ({"seconds": 0.3}, r"`seconds` must be between 0\.4 and 9\.8, got 0\.3"),
        ({"seconds": 10}, r"`seconds` must be between 0\.4 and 9\.8, got 10"),
        ({"seconds": math.inf}, r"`seconds` must be between 0\.4 and 9\.8, got inf"),
        ({"seconds": math.nan}, "`seconds` must be a number, got nan"),
        ({"seconds": "6"}, "`seconds` must be a number, got '6'"),
        ({"frames": 7}, "`frames` must be between 8 and 196, got 7"),
        ({"frames": 197}, "`frames` must be between 8 and 196, got 197"),
        ({"frames": 40.0}, r"`frames` must be a whole number, got 40\.0"),
        ({"frames": True}, "`frames` must be a whole number, got True"),
        ({"samples": 0}, "`samples` must be a whole number of at least 1, got 0"),
        ({"samples": 1.5}, "`samples` must be a whole number"),
        ({"seed": -1}, "`seed` must be a whole number of at least 0, got -1"),
        ({"preset": "perfect"}, "Unknown `preset` 'perfect'. Use one of: fast, balanced, accurate"),
        ({"guidance_scale": math.nan}, "`guidance_scale` must be a finite number, got nan"),
        (
            {"controls": [control(120)], "frames": 120},
            r"names frame 120, but the clip has 120 frames \(0\.\.119\)",
        ),
        ({"controls": [control(joint="LW")]}, r"control 0 \(LW\): .*LW"),
        ({"controls": [control(), control(point=(0, 0.9, 1))]}, "contradict each other: at frame 0"),
    ],
)
def test_unusable_arguments_are_refused_before_anything_runs(tiny_pipeline, monkeypatch, options, message):
    def never(*args, **kwargs):
        raise AssertionError("a network ran")

    monkeypatch.setattr(tiny_pipeline, "generate_latents", never)
    with pytest.raises(ValueError, match=message):
        tiny_pipeline(**{"prompt": PROMPT} | options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": None}, "`preset` must be a name or a Preset, got NoneType"),
        ({"controls": "walk.json"}, "`controls` must be a list of controls, got str"),
        ({"controls": ["pelvis"]}, r"`controls\[0\]` must be a JointControl"),
    ],
)
def test_arguments_of_a_wrong_type_are_refused(tiny_pipeline, options, message):
    with pytest.raises(TypeError, match=message):
        tiny_pipeline(PROMPT, **options)


def test_unknown_joints_are_refused_where_the_control_is_made():
    with pytest.raises(ValueError, match='Unknown joint "tail"'):
        control(joint="tail")


def test_nan_targets_are_refused_where_the_control_is_made():
    with pytest.raises(ValueError, match=r"`positions\[0\]` \(frame 0\) must be finite"):
        control(point=(math.nan, 0, 0))


def test_numpy_numbers_are_numbers(tiny_pipeline):
    plan = Preset(EditingBudget(), steps=1)
    result = tiny_pipeline(PROMPT, frames=np.int64(16), samples=np.int64(2), seed=np.int64(3), preset=plan)
    again = tiny_pipeline(PROMPT, seconds=np.float32(0.8), samples=2, seed=3, preset=plan)
    assert torch.equal(result.latents, again.latents)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 0}, "`steps` must be a whole number of at least 1, got 0"),
        ({"steps": 2.0}, r"`steps` must be a whole number of at least 1, got 2\.0"),
        ({"guidance_scale": math.inf}, "`guidance_scale` must be a finite number, got inf"),
        ({"residual_guidance_scale": "5"}, "`residual_guidance_scale` must be a finite number, got '5'"),
    ],
)
def test_impossible_presets_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Preset(EditingBudget(), **changes)


def test_presets_have_the_papers_iteration_counts():
    """100 logits iterations in each of ten steps and 600 codebook iterations at the end (appendix A.3)."""
    accurate = PRESETS["paper-accurate"]
    assert (accurate.budget.logits_iterations, accurate.budget.latent_iterations, accurate.steps) == (
        100,
        600,
        10,
    )
    assert list(PRESETS)[:3] == ["fast", "balanced", "accurate"]


def parts_of(pipeline: ControlMM) -> dict:
    return {
        "tokenizer": pipeline.decoder.tokenizer,
        "transformer": pipeline.transformer,
        "residual": pipeline.residual,
        "control": pipeline.control,
        "normalizer": pipeline.decoder.normalizer,
        "text_encoder": pipeline.text_encoder,
    }


CONTROL = ControlBranchConfig.tiny()


@pytest.mark.parametrize(
    ("name", "part", "message"),
    [
        ("text_encoder", lambda: HashingTextEncoder(32), "`text_dim` of `transformer` must be 32, got 64"),
        (
            "tokenizer",
            lambda: RvqVae(dataclasses.replace(RvqVaeConfig.tiny(), codebook_size=16)),
            "`codebook_size` of `transformer` must be 16, got 32",
        ),
        (
            "residual",
            lambda: ResidualTransformer(
                dataclasses.replace(ResidualTransformerConfig.tiny(), num_quantizers=4)
            ),
            "`num_quantizers` of `residual` must be 3, got 4",
        ),
        (
            "normalizer",
            lambda: Normalizer(torch.zeros(251), torch.ones(251)),
            "`feature_dim` of `tokenizer` must be 251, got 263",
        ),
        (
            "control",
            lambda: ControlBranch(dataclasses.replace(CONTROL, downsample=8)),
            "`downsample` of `control` must be 4, got 8",
        ),
        (
            "control",
            lambda: ControlBranch(dataclasses.replace(CONTROL, joints=(0, 22))),
            "`joints` of `control` must be below 22 for the humanml3d skeleton, got 22",
        ),
        (
            "control",
            lambda: ControlBranch(dataclasses.replace(CONTROL, layers=3)),
            "The control branch has",
        ),
    ],
)
def test_parts_that_were_not_made_for_each_other_are_refused(tiny_pipeline, name, part, message):
    with pytest.raises(ValueError, match=message):
        ControlMM(**parts_of(tiny_pipeline) | {name: part()})
