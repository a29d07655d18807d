"""Terms that keep editing natural: against hand-worked cases and autograd, and what they do to a motion."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from controlmm.controls import JointControl
from controlmm.generation.code_spread import CodeSpread
from controlmm.generation.control_residuals import ControlResiduals
from controlmm.generation.editing import EditingBudget
from controlmm.generation.latent_editing import edit_latents
from controlmm.generation.naturalness import Naturalness, NaturalWeights, floor_heights
from controlmm.generation.objective import STRAIN_WEIGHT, ControlObjective
from controlmm.models.rvq_vae import frame_mask
from controlmm.motion.skeleton import HUMANML3D
from controlmm.ops import recover_joints
from controlmm.pipelines import PRESETS, Preset
from controlmm.pipelines.presets import with_limits

WIDTH, FRAMES = 67, 24
ROUNDING = 1e-5  # of float32 sums in another order


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def terms(*, frames: torch.Tensor | None = None, clips: int = 1, **weights: float) -> Naturalness:
    """Terms of motions whose features are all zero, every joint free, no foot at rest, no level floor."""
    nothing = {"nearness": 0.0, "steadiness": 0.0, "feet": 0.0, "floor": 0.0}
    return Naturalness(
        start=torch.zeros(clips, FRAMES, WIDTH),
        is_free=torch.ones(clips, FRAMES, 22, dtype=torch.bool),
        rests=torch.zeros(clips, FRAMES, 4, dtype=torch.bool),
        is_level=torch.zeros(clips, dtype=torch.bool),
        frames=torch.ones(clips, FRAMES, dtype=torch.bool) if frames is None else frames,
        skeleton=HUMANML3D,
        weights=NaturalWeights(**{**nothing, **weights}),
    )


def test_a_shaken_joint_costs_the_change_of_its_velocity_and_jerk():
    """A spike of 1 cm in one frame: differences 1, -1 (order 1) and 1, -3, 3, -1 (order 3), in cm."""
    features = torch.zeros(1, FRAMES, WIDTH)
    features[0, 10, 4 + 3 * 19 + 1] = 0.01  # height of joint 20
    value = terms(steadiness=2.0).values(features, torch.zeros(1, FRAMES, 22, 3))
    torch.testing.assert_close(value, torch.tensor([0.5 * 2.0 * 1e-4 * (2 + 20)]))


def test_where_all_frames_of_a_joint_are_led_targets_decide():
    features = torch.zeros(1, FRAMES, WIDTH)
    features[0, 10, 4 + 3 * 19 : 4 + 3 * 20] = 0.01
    led = terms(steadiness=2.0)
    led.is_free[:, :, 20] = False
    assert led.values(features, torch.zeros(1, FRAMES, 22, 3)) == 0
    led.is_free[:, 11:, 20] = True  # a key in frame 10 must not stick out
    assert led.values(features, torch.zeros(1, FRAMES, 22, 3)) > 0


def test_a_bend_of_the_way_costs_its_jerk():
    """A velocity that is 1 cm a frame more in one frame: second differences 1, -2, 1."""
    features = torch.zeros(1, FRAMES, WIDTH)
    features[0, 10, 1] = 0.01
    value = terms(steadiness=2.0).values(features, torch.zeros(1, FRAMES, 22, 3))
    torch.testing.assert_close(value, torch.tensor([0.5 * 2.0 * 1e-4 * 6]))


def test_a_foot_at_rest_costs_its_steps():
    joints = torch.zeros(1, FRAMES, 22, 3)
    joints[0, 6:, 10] = torch.tensor([0.03, 0.0, 0.04])  # 5 cm between frames 5 and 6
    moving = terms(feet=3.0)
    assert moving.values(torch.zeros(1, FRAMES, WIDTH), joints) == 0
    moving.rests[0, 5, 1] = True
    value = moving.values(torch.zeros(1, FRAMES, WIDTH), joints)
    torch.testing.assert_close(value, torch.tensor([0.5 * 3.0 * 0.05**2]))


def test_floors_are_lowest_points_of_a_second():
    frames = frame_mask(torch.tensor([60]), 64)
    joints = torch.ones(1, 64, 22, 3)
    joints[0, 30, 10, 1], joints[0, 62, 10, 1] = 0.2, -5.0  # the second lies in padding
    floors = floor_heights(joints, frames, HUMANML3D)[0]
    assert torch.equal((floors < 1).nonzero()[:, 0], torch.arange(20, 41))
    assert torch.equal(floors[20:41], torch.full((21,), 0.2))


def test_ground_that_climbs_costs_its_height_above_the_lowest_point():
    joints = torch.full((1, 24, 22, 3), 0.3)
    joints[0, 2, 10, 1] = 0.1
    level = replace(terms(floor=0.5), is_level=torch.tensor([True]))
    value = level.values(torch.zeros(1, FRAMES, WIDTH), joints)
    torch.testing.assert_close(value, torch.tensor([0.5 * 0.5 * 11 * 0.2**2]))  # frames 13 to 23 are far off
    assert replace(level, is_level=torch.tensor([False])).values(torch.zeros(1, FRAMES, WIDTH), joints) == 0


def test_padding_and_neighbours_change_nothing():
    lengths = torch.tensor([24, 16])
    both = terms(frames=frame_mask(lengths, 24), clips=2, steadiness=1.0, feet=1.0, floor=1.0)
    both = replace(both, is_level=torch.tensor([True, True]))
    both.rests[:, 3:9] = True
    features, joints = random(2, FRAMES, WIDTH), random(2, FRAMES, 22, 3, seed=1)
    values = both.values(features, joints)
    features[1, 16:], joints[1, 16:] = 100.0, -100.0
    assert torch.equal(both.values(features, joints), values)
    alone = both.select(torch.tensor([1])).values(features[1:], joints[1:])
    assert torch.equal(alone, values[1:])


@pytest.fixture
def scene(tiny_pipeline):
    """Two clips with a wrist to be 10 cm elsewhere."""
    decoder, frames = tiny_pipeline.decoder, frame_mask(torch.tensor([24, 16]), 24)
    keep = frames[:, ::4, None].float()
    latents = decoder.tokenizer.base_codes[:12].reshape(2, 6, 16) * keep
    mask = torch.zeros(2, 24, 22, 3, dtype=torch.bool)
    mask[:, 9, 20] = True
    targets = decoder(latents, frames) + 0.1
    return decoder, targets, mask, frames, latents, keep


def test_the_start_itself_is_steady(scene):
    decoder, _, mask, frames, latents, _ = scene
    natural = Naturalness.of_start(decoder, latents, mask, frames, NaturalWeights(feet=0.0, floor=0.0))
    features = decoder.features(latents, frames)
    values = natural.values(features[..., :WIDTH], recover_joints(features, joints=22))
    assert values.abs().max() < ROUNDING
    assert not natural.is_free[:, 9, 20].any()
    assert natural.is_level.tolist() == [False, False]  # the wrist has a height


def test_a_start_that_climbs_stairs_keeps_them(scene, monkeypatch):
    decoder, frames = scene[0], torch.ones(2, 96, dtype=torch.bool)
    climbing = torch.zeros(2, 96, 22, 3)
    climbing[0, :, :, 1] = torch.linspace(0, 0.3, 96)[:, None]
    climbing[1, :, :, 1] = torch.linspace(0, 2.0, 96)[:, None]
    monkeypatch.setattr("controlmm.generation.naturalness.recover_joints", lambda *_, **__: climbing)
    latents, mask = torch.zeros(2, 24, 16), torch.zeros(2, 96, 22, 3) > 0
    natural = Naturalness.of_start(decoder, latents, mask, frames, NaturalWeights())
    assert natural.is_level.tolist() == [True, False]


def test_the_gradients_of_gauss_newton_and_of_objectives_are_autograds(scene):
    decoder, targets, mask, frames, latents, _ = scene
    natural = Naturalness.of_start(decoder, latents, mask, frames, NaturalWeights(steadiness=50.0, feet=50.0))
    natural.rests[:, 2:6] = True
    moved = latents + 0.1 * random(2, 6, 16, seed=5) * frames[:, ::4, None]
    leaf = moved.clone().requires_grad_()
    with torch.enable_grad():
        features = decoder.features(leaf, frames)
        strain = natural.values(features[..., :WIDTH], recover_joints(features, joints=22))
        (expected,) = torch.autograd.grad(strain.sum(), leaf)
    residuals = ControlResiduals(decoder, targets, mask, frames, naturalness=natural)
    probes = residuals.probe(moved)
    # Third differences of features that two libraries round differently, each to about 1e-7 of itself.
    strains = torch.tensor([probe.strain for probe in probes])
    torch.testing.assert_close(strains, strain.detach(), rtol=ROUNDING, atol=0)
    no_weights = [torch.zeros_like(probe.residual) for probe in probes]
    size = expected.abs().amax((1, 2)).tolist()
    pulled = residuals.pull(no_weights, strained=[True, False])
    torch.testing.assert_close(pulled[0], expected[0], rtol=1e-3, atol=ROUNDING * size[0])
    assert not pulled[1].any()
    plain = ControlObjective(decoder, targets, mask, frames)
    kept = ControlObjective(decoder, targets, mask, frames, naturalness=natural)
    (loss, gradient), (base, slope) = kept.value_and_gradient(moved), plain.value_and_gradient(moved)
    torch.testing.assert_close(loss - base, STRAIN_WEIGHT * strain.detach(), rtol=1e-3, atol=1e-6)
    wanted = STRAIN_WEIGHT * expected
    torch.testing.assert_close(gradient - slope, wanted, rtol=1e-2, atol=1e-4 * wanted.abs().max().item())
    torch.testing.assert_close(kept.errors(), plain.errors())


@pytest.mark.parametrize("solver", ["auto", "lbfgs", "papers"])
def test_natural_editing_meets_targets_and_strains_less(scene, solver):
    decoder, targets, mask, frames, latents, keep = scene
    objective = ControlObjective(decoder, targets, mask, frames)
    natural = Naturalness.of_start(decoder, latents, mask, frames, NaturalWeights())
    strains, errors = [], []
    for naturalness in (0.0, 1.0):
        budget = EditingBudget(solver=solver, latent_iterations=60, tolerance=0.003, naturalness=naturalness)
        solution = edit_latents(objective, latents, keep, budget)
        features = decoder.features(solution.latents, frames)
        strains.append(natural.values(features[..., :WIDTH], recover_joints(features, joints=22)).sum())
        errors.append(torch.stack([clip.min() for clip in solution.errors]).max())
    assert strains[1] < strains[0]
    assert errors[1] < (0.05 if solver == "papers" else 0.01)  # AdamW weighs errors against naturalness


def test_the_spread_of_codes_is_the_root_of_their_covariance():
    books = [random(50, 6), 0.5 * random(50, 6, seed=1)]
    spread = CodeSpread.of_codebooks(books)
    covariance = sum(torch.cov(book.double().T) for book in books)
    expected = covariance + 0.01 * covariance.diagonal().mean() * torch.eye(6)
    torch.testing.assert_close((spread.matrix @ spread.matrix).double(), expected, rtol=1e-4, atol=1e-5)
    steps, slope = random(3, 6, seed=2), random(3, 6, seed=3)
    torch.testing.assert_close(
        (spread.change(steps) * slope).sum(), (steps * spread.gradient(slope)).sum(), rtol=1e-4, atol=1e-4
    )


def test_fresh_codebooks_have_a_plain_unit():
    assert torch.equal(CodeSpread.of_codebooks([torch.zeros(4, 3)]).matrix, torch.eye(3))


def test_presets_edit_naturally_and_the_papers_do_not():
    natural = {name for name, plan in PRESETS.items() if plan.budget.naturalness == 1}
    assert natural == {"fast", "balanced", "accurate", "exact"}
    assert with_limits(PRESETS["fast"], naturalness=0).budget.naturalness == 0


@pytest.mark.parametrize("value", [-1, float("nan"), float("inf"), "much", True])
def test_an_unusable_strength_is_refused_before_any_network_runs(value, tiny_pipeline):
    tiny_pipeline.transformer = None
    control = JointControl("pelvis", frames=[3], positions=[[0.0, 0.9, 0.1]])
    with pytest.raises(ValueError, match=r"`naturalness` must be a number of at least 0 \(0 none, 1"):
        tiny_pipeline("a person walks", frames=16, controls=[control], naturalness=value)


def test_weights_and_budgets_must_be_numbers():
    with pytest.raises(ValueError, match="`feet` must be a number of at least 0, got -1"):
        NaturalWeights(feet=-1)
    with pytest.raises(ValueError, match="`naturalness` must be a number of at least 0, got nan"):
        Preset(EditingBudget(naturalness=float("nan")))
    assert NaturalWeights(feet=2.0, floor=1.0).times(0.5) == NaturalWeights(0.0025, 1.0, 1.0, 0.5)
