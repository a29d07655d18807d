"""Logits editing of the last decoding step, which sees the residual layers."""

from __future__ import annotations

import pytest
import torch

from controlmm.controls import JointControl
from controlmm.generation import logits_editing
from controlmm.generation.decoding_rules import DecodingRules
from controlmm.generation.editing import EditingBudget
from controlmm.pipelines import Preset

HEAD = JointControl("head", frames=[5], positions=[[0, 1.5, 0.3]])


def last_logits_edited(pipeline, budget, last_edit, monkeypatch):
    """For each call: the step's iterations and whether there were finer latents."""
    seen = []

    def kept(logits, *_, iterations, finer, **__):
        seen.append((iterations, torch.is_tensor(finer)))
        return logits

    monkeypatch.setattr(logits_editing, "edit_logits", kept)
    preset = Preset(budget, steps=3, rules=DecodingRules(last_edit=last_edit))
    pipeline("a person walks", frames=16, controls=[HEAD], preset=preset)
    return seen


def test_the_last_edit_is_made_as_often_but_with_all_layers(tiny_pipeline, monkeypatch):
    budget = EditingBudget(logits_iterations=2, logits_iterations_grow=True, latent_iterations=0)
    found = {
        rule: last_logits_edited(tiny_pipeline, budget, rule, monkeypatch) for rule in ("base", "all_layers")
    }
    assert found["base"] == [(2, False), (4, False), (6, False)]
    assert found["all_layers"] == [(2, False), (4, False), (6, True)]


@pytest.mark.parametrize("final_tokens", ["mixture", "sampled"])
def test_motions_end_nearer_to_their_targets_when_the_last_edit_sees_all_layers(tiny_pipeline, final_tokens):
    errors = {}
    for rule in ("base", "all_layers"):
        preset = Preset(
            EditingBudget(logits_iterations=40, latent_iterations=0),
            steps=2,
            rules=DecodingRules(last_edit=rule, final_tokens=final_tokens, editing_noise="none"),
        )
        errors[rule] = tiny_pipeline(
            "a person walks", frames=16, controls=[HEAD], preset=preset
        ).control_error
    assert errors["all_layers"] < 0.8 * errors["base"]


def test_without_logits_editing_the_rule_of_the_last_edit_changes_nothing(tiny_pipeline):
    latents = [
        tiny_pipeline(
            "a person walks",
            frames=16,
            controls=[HEAD],
            preset=Preset(EditingBudget(latent_iterations=2), steps=2, rules=DecodingRules(last_edit=rule)),
        ).latents
        for rule in ("base", "all_layers")
    ]
    assert torch.equal(*latents)
