"""Guidance scales: the model's, unless a preset or a call has its own."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest

from controlmm import ControlMM
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
    tiny_pipeline.guidance = Guidance(1.5, 2.5)
    plan = tiny_pipeline.resolve_preset(preset, None)
    assert (plan.guidance_scale, plan.residual_guidance_scale) == (1.5, 2.5)
    assert tiny_pipeline.resolve_preset(preset, 7.0).guidance_scale == 7.0
    own = replace(PRESETS[preset], guidance_scale=0.0, residual_guidance_scale=1.0)
    assert tiny_pipeline.resolve_preset(own, None) == own


def test_the_scales_change_the_motion(tiny_pipeline):
    made = []
    for scales in (Guidance(), Guidance(base=40.0), Guidance(residual=40.0)):
        tiny_pipeline.guidance = scales
        made.append(tiny_pipeline("walks", frames=24, preset="fast", seed=1).latents)
    asked = tiny_pipeline("walks", frames=24, preset="fast", seed=1, guidance_scale=40.0).latents
    assert not made[0].equal(made[1])
    assert not made[0].equal(made[2])
    assert not asked.equal(made[2])


def test_a_folder_keeps_them(tiny_pipeline, tmp_path):
    tiny_pipeline.guidance = Guidance(2.0, 3.0)
    folder = tiny_pipeline.save_pretrained(tmp_path / "model")
    assert ControlMM.from_pretrained(folder, text_encoder=TEXT).guidance == Guidance(2.0, 3.0)
    about = json.loads((folder / "pipeline.json").read_text())
    del about["guidance"]
    (folder / "pipeline.json").write_text(json.dumps(about))
    assert ControlMM.from_pretrained(folder, text_encoder=TEXT).guidance == Guidance(4.0, 5.0)


@pytest.mark.parametrize(
    ("stored", "message"),
    [
        ({"base": "2"}, "`base` of the guidance must be a finite number, got '2'"),
        ({"base": 2.0, "text": 1.0}, "`guidance` has the scales base, residual, control; got text, too"),
        (3.0, "pipeline.json: `guidance` must hold the scales base, residual and control, got 3.0"),
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
