"""Gauss-Newton by a clip's own Jacobian, against autograd and dense linear algebra."""

from __future__ import annotations

from importlib import import_module
from types import SimpleNamespace

import pytest
import torch

from controlmm.generation.control_residuals import ControlResiduals
from controlmm.generation.naturalness import Naturalness, NaturalWeights
from controlmm.generation.solvers import Stopping, gauss_newton
from controlmm.generation.solvers.curvature import Curvature
from controlmm.generation.solvers.known_rows import MOST_ROWS, KnownRows, ShortestWay
from controlmm.models.rvq_vae import frame_mask


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def scene(tiny_pipeline):
    """Clips of 24 and 16 frames, a few joints to be moved a little from where random codes put them."""
    decoder, frames = tiny_pipeline.decoder, frame_mask(torch.tensor([24, 16]), 24)
    keep = frames[:, ::4, None].float()
    latents = decoder.tokenizer.base_codes[:12].reshape(2, 6, 16) * keep
    targets = decoder(latents, frames) + 0.1 * random(2, 24, 22, 3, seed=1)
    mask = torch.zeros(2, 24, 22, 3, dtype=torch.bool)
    mask[0, 20, 0] = mask[0, 3, 15] = mask[1, 9, 20] = mask[1, 14, 0, 0] = True
    return SimpleNamespace(
        decoder=decoder, targets=targets, mask=mask, frames=frames, latents=latents, keep=keep
    )


@pytest.mark.parametrize("is_natural", [False, True])
@pytest.mark.parametrize("held", [0, 8])
def test_the_jacobian_is_that_of_autograd(scene, is_natural, held):
    """Also where all joints are decoded for the sake of naturalness, and where first frames are held."""
    natural = None
    if is_natural:
        natural = Naturalness.of_start(
            scene.decoder, scene.latents, scene.mask, scene.frames, NaturalWeights()
        )
    residuals = ControlResiduals(
        scene.decoder,
        scene.targets,
        scene.mask,
        scene.frames,
        naturalness=natural,
        prefix=scene.latents + 0.1 if held else None,
        prefix_frames=held,
    )
    probes = residuals.probe(scene.latents)
    for clip, probe in enumerate(probes):
        jacobian = residuals.jacobian(clip, probe)
        units = torch.eye(len(probe.residual), dtype=torch.float64)
        nobody = [None] * len(probes)
        expected = [residuals.pull([*nobody[:clip], unit, *nobody[clip + 1 :]])[clip] for unit in units]
        assert held or jacobian.abs().amax((1, 2)).min() > 0
        torch.testing.assert_close(jacobian, torch.stack(expected), rtol=1e-4, atol=1e-6)


def test_steps_are_the_shortest_ones():
    rows, residual = random(4, 30), random(4, seed=1).double()
    known = KnownRows(rows)
    expected = -torch.linalg.pinv(rows) @ residual.float()
    torch.testing.assert_close(known.step(residual), expected, rtol=5e-3, atol=1e-3)


def test_bent_steps_avoid_what_is_stiff():
    """In the inverse Hessian's metric: of all steps that remove the residual the least ``s^T B s``."""
    rows, residual = random(3, 10), random(3, seed=1).double()
    stiff = torch.zeros(10)
    stiff[2] = 1.0
    memory = Curvature(5)
    memory.add(stiff, 50 * stiff)
    memory.add(random(10, seed=2) * (1 - stiff), random(10, seed=2) * (1 - stiff))
    known = KnownRows(rows)
    plain = known.step(residual)
    known.bend(memory)
    bent = known.step(residual)
    assert bent[2].abs() < 0.1 * plain[2].abs()
    torch.testing.assert_close(rows @ bent, -residual.float(), rtol=5e-3, atol=5e-3)


def test_wrong_rows_are_corrected_by_what_steps_change():
    """A linear problem whose rows are known to a third: each step teaches what is wrong with them."""
    true, residual = random(4, 30), random(4, seed=1).double()
    known = KnownRows(true + 0.3 * random(4, 30, seed=2))
    first = SimpleNamespace(residual=residual, loss=residual.square().mean().item())
    way = ShortestWay(known, torch.zeros(30), first)
    losses = [first.loss]
    while losses[-1] > 1e-8 * losses[0]:
        point = way.next()
        left = residual + (true @ point).double()
        losses.append(left.square().mean().item())
        assert way.see(point, SimpleNamespace(residual=left, loss=losses[-1]))
    assert len(losses) <= 8
    torch.testing.assert_close(way.best, point)


def test_a_way_that_leads_nowhere_ends_where_it_was_best():
    known = KnownRows(random(2, 10))
    residual = random(2, seed=1).double()
    way = ShortestWay(known, torch.zeros(10), SimpleNamespace(residual=residual, loss=1.0))
    worse = SimpleNamespace(residual=2 * residual, loss=4.0)
    points = [way.next()]
    assert way.see(points[0], worse)
    points.append(way.next())
    assert way.see(points[1], worse)
    assert points[1].norm() < 0.5 * points[0].norm()  # shorter where the longer step led away
    assert not way.see(way.next(), worse)
    assert not way.best.any()
    assert not way.has_helped


def test_few_coordinates_take_few_evaluations(scene, monkeypatch):
    """Near the targets, where rows still hold: fewer than by the average metric."""
    start = scene.decoder(scene.latents, scene.frames)
    targets = start + 0.2 * (scene.targets - start)
    mask = scene.mask.clone()
    mask[0, 3] = False  # so early, the root has hardly any way to answer
    residuals = ControlResiduals(scene.decoder, targets, mask, scene.frames)
    assert max(residuals.coordinates) <= MOST_ROWS
    stopping = Stopping(iterations=60, error=1e-3)
    known = gauss_newton(residuals, scene.latents, scene.keep, stopping)
    monkeypatch.setattr(import_module("controlmm.generation.solvers.gauss_newton"), "MOST_ROWS", 0)
    average = gauss_newton(residuals, scene.latents, scene.keep, stopping)
    assert known.reasons == average.reasons == ("target met", "target met")
    assert known.evaluations.sum() < average.evaluations.sum()
    assert known.evaluations.max() <= 10


@pytest.mark.parametrize(("error", "are_made"), [(1.0, False), (1e-4, True)])
def test_rows_are_made_only_for_what_the_natural_part_leaves(scene, error, are_made, monkeypatch):
    made = []
    jacobian = ControlResiduals.jacobian
    monkeypatch.setattr(
        ControlResiduals, "jacobian", lambda *arguments: made.append(1) or jacobian(*arguments)
    )
    natural = Naturalness.of_start(
        scene.decoder, scene.latents, scene.mask, scene.frames, NaturalWeights().times(0.01)
    )
    residuals = ControlResiduals(scene.decoder, scene.targets, scene.mask, scene.frames, naturalness=natural)
    gauss_newton(residuals, scene.latents, scene.keep, Stopping(iterations=40, error=error))
    assert bool(made) == are_made


def test_targets_that_rows_cannot_reach_do_not_stop_the_others(scene):
    """No latents move the root at frame 0; the rest is met, and iterations are not exceeded."""
    mask = torch.zeros_like(scene.mask)
    mask[:, 0, 0, 0] = mask[:, 12, 0, 0] = True
    targets = scene.targets.clone()
    targets[:, 0, 0, 0] = 0.1
    residuals = ControlResiduals(scene.decoder, targets, mask, scene.frames)
    solution = gauss_newton(residuals, scene.latents, scene.keep, Stopping(iterations=25, error=1e-3))
    joints = scene.decoder(solution.latents, scene.frames)
    assert (joints[:, 12, 0, 0] - targets[:, 12, 0, 0]).abs().max() < 1e-3
    assert solution.evaluations.max() <= 40


@pytest.mark.parametrize("iterations", [0, 1, 3])
@pytest.mark.parametrize("is_natural", [False, True])
def test_no_more_steps_than_allowed(scene, iterations, is_natural):
    natural = None
    if is_natural:
        natural = Naturalness.of_start(
            scene.decoder, scene.latents, scene.mask, scene.frames, NaturalWeights()
        )
    residuals = ControlResiduals(scene.decoder, scene.targets, scene.mask, scene.frames, naturalness=natural)
    solution = gauss_newton(residuals, scene.latents, scene.keep, Stopping(iterations=iterations))
    assert (solution.evaluations >= 1).all()
    if iterations <= 1:  # later, a step may take several trials
        assert solution.evaluations.max() <= iterations + 1
    assert all(losses.min() <= losses[0] for losses in solution.losses)
