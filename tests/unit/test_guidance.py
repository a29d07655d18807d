"""Guidance scales: the model's, unless a preset or a call has its own."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest

from controlmm import ControlMM, JointControl
from controlmm.models.masked_transformer import MaskedTransformer
from controlmm.pipelines import PRESETS
from controlmm.pipelines.folder import shipped_folder
from controlmm.pipelines.guidance import TRAINED_HERE, Guidance
from controlmm.text import HashingTextEncoder

TEXT = HashingTextEncoder(64)


def test_a_published_model_has_the_published_scales(tiny_pipeline):
    plan = tiny_pipeline.resolve_preset("accurate", None)
    assert (plan.guidance_scale, plan.residual_guidance_scale) == (4.0, 5.0)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_takes_what_suits_the_model(tiny_pipeline, preset):
    """But for thorough ones, which guide in all steps, as a scale of the caller's own does."""
    tiny_pipeline.guidance = Guidance(1.5, 2.5, share=0.25)
    plan = tiny_pipeline.resolve_preset(preset, None)
    assert (plan.guidance_scale, plan.residual_guidance_scale) == (1.5, 2.5)
    assert plan.guided_share == (0.25 if preset in ("fast", "balanced") else 1.0)
    asked = tiny_pipeline.resolve_preset(preset, 7.0)
    assert (asked.guidance_scale, asked.guided_share) == (7.0, 1.0)
    own = replace(PRESETS[preset], guidance_scale=0.0, residual_guidance_scale=1.0, guided_share=0.0)
    assert tiny_pipeline.resolve_preset(own, None) == own


def test_the_scales_change_the_motion(tiny_pipeline):
    made = []
    for scales in (Guidance(), Guidance(base=40.0), Guidance(residual=40.0), Guidance(base=40.0, share=0.5)):
        tiny_pipeline.guidance = scales
        made.append(tiny_pipeline("walks", frames=24, preset="fast", seed=1).latents)
    asked = tiny_pipeline("walks", frames=24, preset="fast", seed=1, guidance_scale=40.0).latents
    assert not made[0].equal(made[1])
    assert not made[0].equal(made[2])
    assert not made[1].equal(made[3])
    assert not asked.equal(made[2])


@pytest.mark.parametrize("is_controlled", [False, True])
@pytest.mark.parametrize(("share", "passes"), [(0.0, 4), (0.5, 6), (0.6, 7), (1.0, 8)])
def test_steps_without_guidance_cost_one_prediction(tiny_pipeline, monkeypatch, is_controlled, share, passes):
    """Of four steps; the text is predicted with, and where guided, without."""
    seen, logits = [], MaskedTransformer.logits
    monkeypatch.setattr(MaskedTransformer, "logits", lambda *args: seen.append(len(args[1])) or logits(*args))
    plan = replace(PRESETS["fast"], steps=4, guided_share=share)
    controls = [JointControl("head", frames=[5], positions=[[0, 1.5, 0.3]])] if is_controlled else []
    tiny_pipeline("walks", frames=24, preset=plan, controls=controls)
    assert sum(seen) == passes


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan"), "half"])
def test_impossible_shares_are_refused(share):
    with pytest.raises(ValueError, match="`guided_share` must be from 0 to 1"):
        replace(PRESETS["fast"], guided_share=share)


def test_a_folder_keeps_them(tiny_pipeline, tmp_path):
    tiny_pipeline.guidance = Guidance(2.0, 3.0, share=0.5)
    folder = tiny_pipeline.save_pretrained(tmp_path / "model")
    assert ControlMM.from_pretrained(folder, text_encoder=TEXT).guidance == Guidance(2.0, 3.0, share=0.5)
    about = json.loads((folder / "pipeline.json").read_text())
    del about["guidance"]
    (folder / "pipeline.json").write_text(json.dumps(about))
    assert ControlMM.from_pretrained(folder, text_encoder=TEXT).guidance == Guidance(4.0, 5.0)


@pytest.mark.parametrize(
    ("stored", "message"),
    [
        ({"base": "2"}, "`base` of the guidance must be a finite number, got '2'"),
        ({"base": 2.0, "text": 1.0}, "`guidance` has base, residual, control, share; got text, too"),
        ({"share": 1.5}, "`share` of the guidance must be from 0 to 1, got 1.5"),
        (3.0, "pipeline.json: `guidance` must hold numbers such as base and residual, got 3.0"),
    ],
)
def test_a_folder_with_other_scales_is_refused(tiny_pipeline, tmp_path, stored, message):
    folder = tiny_pipeline.save_pretrained(tmp_path / "model")
    about = json.loads((folder / "pipeline.json").read_text()) | {"guidance": stored}
    (folder / "pipeline.json").write_text(json.dumps(about))
    with pytest.raises(ValueError, match=re.escape(message)):
        ControlMM.from_pretrained(folder, text_encoder=TEXT)


def test_the_model_that_ships_has_its_own():
    about = json.loads((shipped_folder() / "pipeline.json").read_text())
    assert Guidance.of(about["guidance"]) == TRAINED_HERE
