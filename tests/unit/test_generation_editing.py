"""Logits editing and the control objective, against known minima and against the tiny decoder."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import controlmm.generation.observed_logits as observed_logits_module
from controlmm.generation.decoding_request import DecodingRequest
from controlmm.generation.editing import EditingBudget
from controlmm.generation.logits_editing import LogitsEditing, edit_logits
from controlmm.generation.noise import ClipNoise
from controlmm.generation.objective import ControlObjective, control_error
from controlmm.generation.observed_logits import observed_logits
from controlmm.models.rvq_vae import frame_mask

ROUNDING = 1e-5  # of float32 gradients through the decoder in another order


class Quadratic:
    """Squared distance of the latents to a target, for each clip."""

    def __init__(self, target: torch.Tensor) -> None:
        self.target, self.calls = target, 0

    def value_and_gradient(self, latents):
        self.calls += 1
        difference = latents.detach() - self.target
        return difference.square().sum((1, 2)), 2 * difference


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_logits_learn_to_choose_the_wanted_code():
    codes = torch.eye(4)
    wanted = torch.tensor([[2, 0, 3]])
    objective = Quadratic(codes[wanted])
    edited = edit_logits(
        torch.zeros(1, 3, 4),
        objective,
        codes,
        iterations=150,
        noise=lambda: torch.zeros(1, 3, 4),
        keep=torch.ones(1, 3, 1),
    )
    assert torch.equal(edited.argmax(-1), wanted)
    assert edited.softmax(-1).amax(-1).min() > 0.9


def test_fresh_noise_is_drawn_for_every_gradient_step_of_the_logits():
    draws = []

    def noise():
        draws.append(len(draws))
        return torch.zeros(1, 3, 4)

    edit_logits(
        torch.zeros(1, 3, 4),
        Quadratic(torch.ones(1, 3, 4)),
        torch.eye(4),
        iterations=7,
        noise=noise,
        keep=torch.ones(1, 3, 1),
    )
    assert len(draws) == 7


@pytest.mark.parametrize("budget", [{"logits_iterations": -1}, {"latent_iterations": -5}])
def test_negative_budgets_are_refused(budget):
    with pytest.raises(ValueError, match="Iterations must not be negative"):
        EditingBudget(**budget)


@pytest.fixture
def scene(tiny_pipeline):
    """A batch of 6 and 4 tokens with random targets on some joints of the valid frames."""
    frames = frame_mask(torch.tensor([24, 16]), 24)
    mask = (torch.rand(2, 24, 22, 3, generator=torch.Generator().manual_seed(2)) < 0.05) & frames[
        ..., None, None
    ]
    return tiny_pipeline.decoder, random(2, 24, 22, 3, seed=1), mask, frames


def test_objective_is_the_mean_squared_error_with_its_gradient(scene):
    decoder, targets, mask, frames = scene
    latents = random(2, 6, 16).requires_grad_()
    value, gradient = ControlObjective(decoder, targets, mask, frames).value_and_gradient(latents)
    joints = decoder(latents, frames)
    expected = torch.stack([(joints - targets)[clip][mask[clip]].square().mean() for clip in range(2)])
    (expected_gradient,) = torch.autograd.grad(expected.sum(), latents)
    torch.testing.assert_close(value, expected.detach(), rtol=ROUNDING, atol=ROUNDING)
    torch.testing.assert_close(gradient, expected_gradient, rtol=1e-4, atol=ROUNDING)
    assert gradient[1, 4:].abs().max() == 0


def test_a_clips_objective_does_not_depend_on_the_clips_beside_it(scene):
    decoder, targets, mask, frames = scene
    latents = random(2, 6, 16)
    value, gradient = ControlObjective(decoder, targets, mask, frames).value_and_gradient(latents)
    alone = ControlObjective(decoder, targets[1:, :16], mask[1:, :16], frames[1:, :16])
    other_value, other_gradient = alone.value_and_gradient(latents[1:, :4])
    torch.testing.assert_close(value[1:], other_value, rtol=ROUNDING, atol=ROUNDING)
    torch.testing.assert_close(gradient[1:, :4], other_gradient, rtol=1e-4, atol=ROUNDING)


def test_selected_clips_have_the_objective_they_had_in_the_batch(scene):
    decoder, targets, mask, frames = scene
    latents = random(2, 6, 16)
    objective = ControlObjective(decoder, targets, mask, frames)
    value, gradient = objective.value_and_gradient(latents)
    selected = objective.select(torch.tensor([1]))
    other_value, other_gradient = selected.value_and_gradient(latents[1:])
    torch.testing.assert_close(value[1:], other_value, rtol=ROUNDING, atol=ROUNDING)
    torch.testing.assert_close(gradient[1:], other_gradient, rtol=1e-4, atol=ROUNDING)
    assert torch.equal(selected.errors(), (3 * other_value).sqrt())


def test_the_error_of_an_objective_bounds_the_mean_distance(scene):
    decoder, targets, mask, frames = scene
    latents = random(2, 6, 16)
    objective = ControlObjective(decoder, targets, mask, frames)
    objective.value_and_gradient(latents)
    assert (objective.errors() >= control_error(decoder(latents, frames), targets, mask)).all()


def test_repeated_evaluations_do_not_disturb_each_other(scene):
    decoder, targets, mask, frames = scene
    objective = ControlObjective(decoder, targets, mask, frames)
    first = [part.clone() for part in objective.value_and_gradient(random(2, 6, 16))]
    kept = objective.value_and_gradient(random(2, 6, 16))
    objective.value_and_gradient(random(2, 6, 16, seed=9))
    for one, other in zip(first, kept, strict=True):
        assert torch.equal(one, other)


def test_control_error_is_the_distance_along_the_controlled_axes():
    joints, targets = torch.zeros(2, 4, 22, 3), torch.zeros(2, 4, 22, 3)
    mask = torch.zeros(2, 4, 22, 3, dtype=torch.bool)
    mask[0, 1, 5] = True
    mask[0, 3, 0, [0, 2]] = True
    targets[0, 1, 5] = torch.tensor([0.0, 3.0, 4.0])  # 5 m away
    targets[0, 3, 0] = torch.tensor([1.0, 99.0, 0.0])  # 1 m away, height free
    assert control_error(joints, targets, mask).tolist() == [3.0, 0.0]


def test_logits_editing_lowers_the_error_of_the_decoded_motion(scene):
    decoder, targets, mask, frames = scene
    codes, keep = decoder.tokenizer.base_codes, frames[:, ::4, None].float()
    objective = ControlObjective(decoder, targets, mask, frames)
    logits = random(2, 6, 32)
    edited = edit_logits(
        logits, objective, codes, iterations=40, noise=lambda: torch.zeros_like(logits), keep=keep
    )
    before, after = (objective.value_and_gradient(x.softmax(-1) @ codes * keep)[0] for x in (logits, edited))
    assert (after < before).all()


def test_logits_are_edited_or_observed():
    with pytest.raises(ValueError, match="set `logits_iterations` to 0 or `observes_targets` to False"):
        EditingBudget(logits_iterations=5, observes_targets=True)


@pytest.fixture
def observed(tiny_pipeline, monkeypatch):
    """Logits, codes, and an objective whose targets other codes meet; two clips of six tokens."""
    monkeypatch.setattr(observed_logits_module, "_NEAR", 0.001)  # an untrained decoder moves joints little
    decoder = tiny_pipeline.decoder
    codes = decoder.tokenizer.base_codes
    logits, elsewhere = (random(2, 6, len(codes), seed=seed) for seed in (3, 4))
    frames = torch.ones(2, 24, dtype=torch.bool)
    mask = torch.zeros(2, 24, 22, 3, dtype=torch.bool)
    mask[:, ::4, [0, 20]] = True
    targets = decoder((4 * elsewhere).softmax(-1) @ codes, frames).detach()
    return logits, codes, ControlObjective(decoder, targets, mask, frames)


def expected_error(logits, codes, objective):
    joints = objective.decoder(logits.softmax(-1) @ codes, objective.frames)
    return control_error(joints, objective.targets, objective.mask)


def test_observed_logits_expect_codes_nearer_to_the_targets(observed):
    logits, codes, objective = observed
    found = logits
    for _ in range(3):
        found = observed_logits(found, objective.residuals(), codes, torch.ones(2, 6, 1))
    before, after = expected_error(logits, codes, objective), expected_error(found, codes, objective)
    assert (after < 0.9 * before).all()


def test_tokens_that_may_not_change_are_not_observed(observed):
    logits, codes, objective = observed
    keep = torch.ones(2, 6, 1)
    keep[0, :3] = keep[1] = 0
    found = observed_logits(logits, objective.residuals(), codes, keep)
    is_same = (found == logits).all(-1)
    assert torch.equal(is_same, keep[..., 0] == 0)
    logits[0, 0] = random(len(codes), seed=5)
    again = observed_logits(logits, objective.residuals(), codes, keep)
    assert not torch.equal(again[0, 3:], found[0, 3:])  # what they decode to counts all the same


def test_logits_that_meet_their_targets_stay(observed):
    logits, codes, objective = observed
    targets = objective.decoder(logits.softmax(-1) @ codes, objective.frames).detach()
    met = ControlObjective(objective.decoder, targets + 1e-4, objective.mask, objective.frames)
    assert torch.equal(observed_logits(logits, met.residuals(), codes, torch.ones(2, 6, 1)), logits)


def test_what_is_near_is_measured_in_metres(observed):
    logits, codes, objective = observed
    residuals = objective.residuals()
    probe = residuals.probe(logits.softmax(-1) @ codes)[0]
    assert observed_logits_module._force(residuals, probe) is not None
    assert observed_logits_module._force(residuals, replace(probe, metres=1e-3)) is None


def observing(tiny_pipeline, objective):
    request = DecodingRequest(torch.zeros(2, 4), torch.ones(2, 6, dtype=torch.bool), ClipNoise([0, 1]))
    return LogitsEditing(objective, tiny_pipeline.tokenizer, request, EditingBudget(observes_targets=True))


def test_nothing_is_observed_beside_other_terms(observed, tiny_pipeline):
    logits, _, objective = observed

    class Height:
        def values(self, joints):
            return joints[:, :, 0, 1].sum(1)

        def select(self, clips):
            return self

    beside = ControlObjective(
        objective.decoder, objective.targets, objective.mask, objective.frames, terms=[Height()]
    )
    assert torch.equal(observing(tiny_pipeline, beside).within(logits, 0), logits)


def test_only_clips_that_lead_more_than_the_pelvis_are_observed(observed, tiny_pipeline):
    """Where the pelvis alone is led, it made nothing better on validation clips."""
    logits, _, objective = observed
    objective.mask[0, :, 1:] = False
    found = observing(tiny_pipeline, objective).within(logits, 9)
    assert torch.equal(found[0], logits[0])
    assert not torch.equal(found[1], logits[1])
