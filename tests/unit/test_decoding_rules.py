"""Where the paper and the published code decode in different ways: both sides of every option."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from controlmm.controls import JointControl
from controlmm.generation import logits_editing
from controlmm.generation.decoding_request import DecodingRequest
from controlmm.generation.decoding_rules import DecodingRules, likeliest_share
from controlmm.generation.editing import EditingBudget
from controlmm.generation.logits_editing import LogitsEditing, edit_logits
from controlmm.generation.masked_decoding import (
    decode_from_text,
    decode_with_control,
    fill_residual_layers,
    final_base_ids,
    final_latents,
)
from controlmm.generation.noise import ClipNoise
from controlmm.generation.objective import ControlObjective, control_error
from controlmm.generation.solvers import Stopping, gradient_descent
from controlmm.ops import obstacle_loss
from controlmm.ops.obstacles import Sphere
from controlmm.pipelines import PRESETS, Preset

EXACT = 1e-6


def request(tokens=6, *, steps=3, seed=0, **rules) -> DecodingRequest:
    return DecodingRequest(
        torch.ones(1, 64),
        torch.ones(1, tokens, dtype=torch.bool),
        ClipNoise([seed]),
        steps=steps,
        rules=DecodingRules(**rules),
    )


def objective_of(pipeline, tokens=6, *, norm="mse") -> ControlObjective:
    targets = torch.randn(1, 4 * tokens, 22, 3, generator=torch.Generator().manual_seed(1))
    mask = torch.zeros_like(targets, dtype=torch.bool)
    mask[:, 3, 0] = mask[:, 20, 15] = True
    frames = torch.ones(1, 4 * tokens, dtype=torch.bool)
    return ControlObjective(pipeline.decoder, targets, mask, frames, norm=norm)


def final_logits(pipeline, *, budget=None, wanted=None, **rules):
    objective, wanted = objective_of(pipeline), wanted or request(**rules)
    return decode_with_control(
        pipeline.transformer,
        pipeline.control,
        pipeline.decoder,
        objective,
        wanted,
        editing=LogitsEditing(objective, pipeline.tokenizer, wanted, budget or EditingBudget()),
    )


class Linear:
    """A loss whose gradient is the same everywhere."""

    def __init__(self, slope):
        self.slope = slope

    def value_and_gradient(self, latents):
        return (latents * self.slope).sum((1, 2)).detach() + 100, self.slope.expand_as(latents)

    def select(self, clips):
        return self


# --- row 1: iterations ---


def test_the_papers_accurate_preset_has_the_codes_iterations_and_the_papers_other_reading_is_reachable():
    assert PRESETS["paper-accurate"].budget.logits_iterations == 100
    assert PRESETS["paper-accurate"].budget.latent_iterations == 600
    other = Preset(EditingBudget(logits_iterations=600, latent_iterations=100))
    assert (other.budget.logits_iterations_in(0), other.budget.latent_iterations) == (600, 100)


def test_iterations_are_per_step_or_grow_as_the_published_command_has_them():
    constant = EditingBudget(logits_iterations=100)
    growing = EditingBudget(logits_iterations=35, logits_iterations_grow=True)
    assert [constant.logits_iterations_in(step) for step in (0, 9)] == [100, 100]
    assert sum(growing.logits_iterations_in(step) for step in range(10)) == 1925


def test_every_decoding_step_edits_as_often_as_it_should(tiny_pipeline, monkeypatch):
    seen = []

    def kept(logits, *_, iterations, **__):
        seen.append(iterations)
        return logits

    monkeypatch.setattr(logits_editing, "edit_logits", kept)
    constant = EditingBudget(logits_iterations=2)
    growing = EditingBudget(logits_iterations=2, logits_iterations_grow=True)
    final_logits(tiny_pipeline, budget=constant, last_edit="base")
    final_logits(tiny_pipeline, budget=growing, last_edit="base")
    assert seen == [2, 2, 2, 2, 4, 6]


# --- row 5: the control loss at inference ---


def test_editing_minimises_a_mean_square_or_a_mean_distance(tiny_pipeline):
    latents = torch.randn(1, 6, 16, generator=torch.Generator().manual_seed(2))
    joints = tiny_pipeline.decoder(latents)
    found = {}
    for norm in ("mse", "l2", "l1"):
        objective = objective_of(tiny_pipeline, norm=norm)
        found[norm] = objective.value_and_gradient(latents)[0]
        distance = control_error(joints, *(x.contiguous() for x in (objective.targets, objective.mask)))
        assert (objective.errors() >= distance - EXACT).all()
    errors = (joints - objective.targets)[objective.mask]
    torch.testing.assert_close(found["mse"], errors.square().mean()[None], rtol=1e-4, atol=EXACT)
    torch.testing.assert_close(found["l1"], errors.abs().mean()[None], rtol=1e-4, atol=EXACT)
    torch.testing.assert_close(found["l2"], distance, rtol=1e-4, atol=EXACT)


def test_the_presets_norm_reaches_the_objective(tiny_pipeline):
    control = JointControl("head", frames=[5], positions=[[0, 1.5, 0.3]])
    results = [
        tiny_pipeline(
            "a person walks",
            frames=16,
            controls=[control],
            preset=Preset(EditingBudget(latent_iterations=5), steps=2, control_norm=norm),
        ).best.joints
        for norm in ("mse", "l2")
    ]
    assert not torch.equal(*results)


# --- row 9: the optimiser of editing ---


def test_plain_gradient_steps_are_rate_times_gradient():
    slope = torch.tensor([[1.0, -2.0]])
    objective, keep = Linear(slope), torch.ones(1, 1, 1)
    solution = gradient_descent(objective, torch.zeros(1, 1, 2), keep, Stopping(iterations=3), rate=0.1)
    torch.testing.assert_close(solution.latents, -0.3 * slope[None])
    with pytest.raises(ValueError, match=r"`gradient_descent` needs `stopping\.iterations`"):
        gradient_descent(objective, torch.zeros(1, 1, 2), keep, Stopping(evaluations=3), rate=0.1)


def test_logits_take_adams_steps_or_plain_ones():
    """Adam's first step has the length of its rate whatever the gradient; a plain step goes with it."""
    codes, logits, keep = torch.eye(3), torch.zeros(1, 1, 3), torch.ones(1, 1, 1)
    slope = torch.tensor([3.0, 0.0, -3.0])
    arguments = {"iterations": 1, "noise": lambda: None, "keep": keep}
    plain = edit_logits(logits, Linear(slope), codes, **arguments, rate=0.5, optimizer="gradient")
    gradient = (slope - slope.mean()) / 3  # through the softmax at equal weights
    torch.testing.assert_close(plain[0, 0], -0.5 * gradient)
    adam = edit_logits(logits, Linear(slope), codes, **arguments, rate=0.5)
    torch.testing.assert_close(adam[0, 0], -0.5 * gradient.sign(), rtol=0, atol=1e-4)


def test_both_optimisers_edit_a_whole_call(tiny_pipeline):
    control = JointControl("head", frames=[5], positions=[[0, 1.5, 0.3]])
    motions = []
    for optimizer in ("adamw", "gradient"):
        budget = EditingBudget(logits_iterations=2, latent_iterations=5, optimizer=optimizer)
        plan = Preset(budget, steps=2)
        motions.append(
            tiny_pipeline("a person walks", frames=16, controls=[control], preset=plan).best.joints
        )
    assert not torch.equal(*motions)


# --- rows 10 and 13: noise in logits editing ---


def test_editing_without_noise_draws_nothing(tiny_pipeline):
    """The noise of a step then starts where it would start without any editing."""
    budget = EditingBudget(logits_iterations=2)
    quiet = request(editing_noise="none")
    final_logits(tiny_pipeline, wanted=quiet, budget=budget)
    unedited = request()
    final_logits(tiny_pipeline, wanted=unedited)
    assert torch.equal(quiet.gumbel(8), unedited.gumbel(8))
    noisy = request()
    final_logits(tiny_pipeline, wanted=noisy, budget=budget)
    assert not torch.equal(noisy.gumbel(8), request().gumbel(8))


def test_every_kind_of_editing_noise_gives_other_logits(tiny_pipeline):
    budget = EditingBudget(logits_iterations=3)
    found = [
        final_logits(tiny_pipeline, budget=budget, editing_noise=n) for n in ("gumbel", "none", "as_printed")
    ]
    assert not any(torch.equal(found[i], found[j]) for i, j in ((0, 1), (0, 2), (1, 2)))


def test_noise_as_printed_stays_out_of_the_denominator():
    """Noise of log 2 on every logit doubles the weights, and with them the latents and the gradient."""
    codes, logits, keep = torch.eye(3), torch.zeros(1, 1, 3), torch.ones(1, 1, 1)
    arguments = {"iterations": 1, "keep": keep, "rate": 1.0, "optimizer": "gradient"}
    noise = torch.full((1, 1, 3), 2.0).log()
    slope = torch.tensor([3.0, 0.0, -3.0])
    quiet, printed = (
        edit_logits(logits, Linear(slope), codes, **arguments, noise=lambda n=n: n, as_printed=True)
        for n in (None, noise)
    )
    torch.testing.assert_close(printed, 2 * quiet)


# --- the noise of the loop ---


def test_tokens_on_the_way_are_drawn_with_a_second_noise_or_without(tiny_pipeline):
    """One noise fewer is drawn a step; the first step's logits do not know of it yet."""
    once = final_logits(tiny_pipeline, noise_twice=False)
    twice = final_logits(tiny_pipeline)
    assert not torch.equal(once, twice)
    left = request(steps=1, noise_twice=False)
    final_logits(tiny_pipeline, wanted=left)
    after_one = request()
    after_one.gumbel(32)
    assert torch.equal(left.gumbel(32), after_one.gumbel(32))


# --- row 11: top-k ---


def test_the_likeliest_share_keeps_logits_and_silences_the_rest():
    logits = torch.tensor([[[0.0, 5.0, 3.0, 1.0]]])
    assert likeliest_share(logits, 0.5).tolist() == [[[-torch.inf, 5.0, 3.0, -torch.inf]]]
    assert likeliest_share(logits, 0.3).isfinite().sum() == 2  # rounded up, as published: 52 of 512
    assert torch.equal(likeliest_share(logits, 1.0), logits)
    assert likeliest_share(torch.randn(1, 1, 512), 0.1).isfinite().sum() == 52


def test_top_k_applies_in_the_loop_only_if_asked(tiny_pipeline, monkeypatch):
    def weights_seen(**rules):
        seen = []
        embed = tiny_pipeline.transformer.embed_soft
        monkeypatch.setattr(tiny_pipeline.transformer, "embed_soft", lambda w: seen.append(w) or embed(w))
        final_logits(tiny_pipeline, **rules)
        monkeypatch.undo()
        return torch.cat(seen)

    assert (weights_seen() > 0).all()
    assert ((weights_seen(top_share=0.1) > 0).sum(-1) == 4).all()  # the top tenth of 32 codes


def test_the_top_share_of_text_decoding_can_be_chosen(tiny_pipeline):
    arguments = (tiny_pipeline.transformer,)
    greedy = {
        tuple(decode_from_text(*arguments, request(seed=s, text_top_share=0.03))[0].tolist())
        for s in range(4)
    }
    free = {
        tuple(decode_from_text(*arguments, request(seed=s, text_top_share=1.0))[0].tolist()) for s in range(4)
    }
    assert len(greedy) == 1  # only the likeliest of 32 codes is left
    assert len(free) == 4


# --- row 12: final tokens ---


def test_final_tokens_are_a_mixture_or_codes_drawn_with_their_probability(tiny_pipeline):
    tokenizer = tiny_pipeline.decoder.tokenizer
    logits = torch.full((1, 4000, 32), -30.0)
    logits[..., 3], logits[..., 7] = 0.0, torch.tensor(3.0).log()
    soft, drawn = request(4000), request(4000, final_tokens="sampled")
    ids = final_base_ids(logits, drawn)
    assert (ids == 7).float().mean().item() == pytest.approx(0.75, abs=4.5 * (0.75 * 0.25 / 4000) ** 0.5)
    assert (final_base_ids(logits, soft) == 7).all()
    layers = torch.stack([ids, torch.full_like(ids, -1), torch.full_like(ids, -1)], dim=-1)
    mean = 0.25 * tokenizer.base_codes[3] + 0.75 * tokenizer.base_codes[7]
    torch.testing.assert_close(final_latents(tokenizer, logits, layers, soft)[0, 0], mean)
    assert torch.equal(final_latents(tokenizer, logits, layers, drawn), tokenizer.base_codes[ids])


# --- row 14: the obstacle loss ---


def test_the_obstacle_sum_is_the_papers_but_for_a_constant_and_the_mean_is_the_codes():
    """Two spheres, three frames, two joints; -min(SDF, d) = max(0, d - SDF) - d in each of the 12 cases."""
    joints = torch.randn(1, 3, 2, 3, generator=torch.Generator().manual_seed(3))
    spheres = [Sphere(center=(0.2, 0.1, 0.0), radius=0.9), Sphere(center=(-0.5, 0.0, 0.3), radius=0.6)]
    distances = torch.stack(
        [
            (joints - torch.tensor(c)).norm(dim=-1) - r
            for c, r in (((0.2, 0.1, 0.0), 0.9), ((-0.5, 0.0, 0.3), 0.6))
        ]
    )
    margin = 0.25
    paper = -distances.clamp(max=margin).sum()
    ours = obstacle_loss(joints, spheres, margin=margin, reduction="sum")
    torch.testing.assert_close(ours[0], paper + 12 * margin, rtol=1e-5, atol=EXACT)
    code = (-distances[:, ..., 1]).clamp(min=0).mean()  # margin 0, one joint, mean over frames and spheres
    torch.testing.assert_close(
        obstacle_loss(joints, spheres, joint_indices=[1])[0], code, rtol=1e-5, atol=EXACT
    )


# --- row 20 and the class of padding in residual layers ---


def test_residual_codes_are_the_likeliest_or_drawn(tiny_pipeline):
    base = torch.tensor([[3, 1, 4, 1, 5, 9]])
    likeliest = [fill_residual_layers(tiny_pipeline.residual, base, request(seed=s)) for s in range(3)]
    assert torch.equal(likeliest[0], likeliest[1])
    rules = {"residual_tokens": "sampled"}
    drawn = [fill_residual_layers(tiny_pipeline.residual, base, request(seed=s, **rules)) for s in range(3)]
    assert not torch.equal(drawn[0], drawn[1])
    assert (drawn[0][..., 1:] >= 0).all()


@pytest.mark.parametrize("tokens", ["likeliest", "sampled"])
def test_no_code_can_win_a_residual_layer_only_if_allowed(tiny_pipeline, monkeypatch, tokens):
    residual = tiny_pipeline.residual
    logits = torch.zeros(2, 6, 33)  # with and without text
    logits[..., 32] = 50.0  # PAD
    logits[..., 5] = 40.0
    monkeypatch.setattr(residual, "forward", lambda *_, **__: logits)
    base = torch.zeros(1, 6, dtype=torch.long)
    masked = fill_residual_layers(residual, base, request(residual_tokens=tokens))
    assert (masked[..., 1:] == 5).all()
    allowed = fill_residual_layers(residual, base, request(residual_tokens=tokens, pad_class=True))
    assert (allowed[..., 1:] == -1).all()


def test_no_code_wins_over_negative_base_logits_only_if_allowed():
    """The published code gives "no code" the logit 0 in the base layer."""
    logits = torch.tensor([[[-3.0, -1.0], [-3.0, 2.0]]])
    assert final_base_ids(logits, request(2)).tolist() == [[1, 1]]
    assert final_base_ids(logits, request(2, pad_class=True)).tolist() == [[-1, 1]]


# --- refusals ---


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"editing_noise": "pink"}, r"`editing_noise` must be one of .*, got 'pink'"),
        ({"final_tokens": "best"}, r"`final_tokens` must be one of"),
        ({"residual_tokens": "best"}, r"`residual_tokens` must be one of"),
        ({"top_share": 0.0}, r"`top_share` must be above 0 and at most 1, got 0\.0"),
        ({"text_top_share": 1.5}, r"`text_top_share` must be above 0 and at most 1"),
    ],
)
def test_impossible_rules_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        DecodingRules(**changes)


def test_impossible_budgets_and_presets_are_refused():
    with pytest.raises(ValueError, match=r"`optimizer` must be one of \('adamw', 'gradient'\), got 'sgd'"):
        EditingBudget(optimizer="sgd")
    with pytest.raises(ValueError, match="`logits_rate` must be positive, got 0"):
        EditingBudget(logits_rate=0)
    with pytest.raises(ValueError, match=r"`control_norm` must be one of .*, got 'huber'"):
        replace(PRESETS["fast"], control_norm="huber")
