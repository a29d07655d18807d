"""Steps for bodies that would slide: whom they are for, and what stays as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from controlmm.controls import PathControl
from controlmm.generation import stepping
from controlmm.generation.objective import ControlObjective
from controlmm.generation.planted_feet import FootStepTerm
from controlmm.generation.step_plan import step_targets
from controlmm.generation.stepping import with_steps
from controlmm.motion.skeleton import HUMANML3D
from controlmm.pipelines import PRESETS

FRAMES = 40
BUDGET = PRESETS["balanced"].budget


@pytest.fixture
def scene(tiny_pipeline):
    """Two clips of unequal lengths: only the first is led, at 1 m/s."""
    decoder = tiny_pipeline.decoder
    codes = decoder.tokenizer.base_codes[:10]
    latents = torch.stack([codes, codes.flip(0)])
    valid = torch.ones(2, 10, dtype=torch.bool)
    valid[0, 8:] = False
    latents = latents * valid[..., None]
    targets, mask = torch.zeros(2, FRAMES, 22, 3), torch.zeros(2, FRAMES, 22, 3, dtype=torch.bool)
    targets[0, :32, 0, 2], mask[0, :32, 0, 2] = torch.arange(32) / 20, True
    frames = valid.repeat_interleave(4, dim=1)
    return ControlObjective(decoder, targets, mask, frames), latents, valid


@pytest.fixture
def all_slide(monkeypatch):
    """A tiny network's random feet do what they like: whoever has targets counts as sliding."""
    monkeypatch.setattr(stepping, "slides", lambda joints, targets, mask, skeleton: bool(mask.any()))


def test_standing_feet_come_to_their_places(scene, all_slide):
    objective, latents, valid = scene
    decoder, inside = objective.decoder, objective.frames[:1, :32]
    before = decoder(latents[:1, :8], inside)[0]
    targets, mask = step_targets(before, objective.targets[0, :32], objective.mask[0, :32], HUMANML3D)
    after = decoder(with_steps(objective, latents, valid, BUDGET)[:1, :8], inside)[0]
    old, new = ((joints - targets)[mask].square().mean().sqrt() for joints in (before, after))
    assert new < 0.95 * old  # a random network of a few channels reaches little


def test_only_clips_that_would_slide_change(scene, all_slide):
    objective, latents, valid = scene
    stepped = with_steps(objective, latents, valid, BUDGET)
    assert torch.equal(stepped[1], latents[1])
    assert not torch.equal(stepped[0], latents[0])
    assert torch.equal(stepped[0, 8:], latents[0, 8:]), "padding stays"


def test_steps_do_not_depend_on_the_batch(scene, all_slide):
    objective, latents, valid = scene
    alone = objective.select(torch.tensor([0]))
    together = with_steps(objective, latents, valid, BUDGET)[:1]
    assert torch.equal(with_steps(alone, latents[:1], valid[:1], BUDGET), together)


@pytest.mark.parametrize(
    "change", [{"naturalness": 0.0}, {"time_budget": 1.0}, {"solver": "papers"}, {"latent_iterations": 0}]
)
def test_budgets_without_steps(scene, all_slide, change):
    objective, latents, valid = scene
    assert with_steps(objective, latents, valid, replace(BUDGET, **change)) is latents


def test_obstacles_do_not_count_while_steps_are_made(scene, all_slide):
    """They bend the way later; whoever goes around them steps all the same."""
    objective, latents, valid = scene
    term = FootStepTerm.of_motion(objective.decoder, latents, objective.frames)
    parts = objective.decoder, objective.targets, objective.mask, objective.frames
    others = ControlObjective(*parts, terms=[term])
    stepped = with_steps(others, latents, valid, BUDGET)
    assert torch.equal(stepped, with_steps(objective, latents, valid, BUDGET))


def test_no_clip_that_slides_costs_no_editing(scene, monkeypatch):
    objective, latents, valid = scene
    monkeypatch.setattr(stepping, "slides", lambda *_: False)
    assert with_steps(objective, latents, valid, BUDGET) is latents


def test_rounds_are_one_phase_that_only_goes_on(scene, all_slide):
    seen = []
    with_steps(*scene, BUDGET, progress=lambda *step: seen.append(step))
    assert {(phase, total) for phase, _, total in seen} == {("planned steps", 40)}
    done = [done for _, done, _ in seen]
    assert done == sorted(done)
    assert done[0] <= 20 < done[-1] <= 40


def test_a_pipeline_steps_before_it_edits(tiny_pipeline, all_slide):
    """Fails where the pipeline leaves steps out: the same call without them ends elsewhere."""
    walk = PathControl("pelvis", xz=np.array([[0.0, 0.0], [0.0, 1.5]]))

    def call() -> torch.Tensor:
        result = tiny_pipeline("a person walks", frames=32, controls=[walk], preset="fast", seed=0)
        return torch.as_tensor(result.best.joints)

    with_them, stepping.slides = call(), lambda *_: False
    assert not torch.equal(with_them, call())
