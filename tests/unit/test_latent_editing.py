"""Which solver edits latents, and when it stops."""

from __future__ import annotations

import pytest
import torch

from controlmm.controls import JointControl
from controlmm.generation import latent_editing
from controlmm.generation.editing import EditingBudget
from controlmm.generation.latent_editing import edit_latents
from controlmm.generation.objective import ControlObjective
from controlmm.generation.solvers import Stopping, lbfgs
from controlmm.pipelines import Preset


@pytest.fixture
def scene(tiny_pipeline):
    decoder = tiny_pipeline.decoder
    latents = decoder.tokenizer.base_codes[:6][None]
    targets = decoder(latents) + 0.05
    mask = torch.zeros(1, 24, 22, 3, dtype=torch.bool)
    mask[0, 20, 0, 0] = mask[0, 20, 0, 2] = True
    return decoder, targets, mask, torch.ones(1, 24, dtype=torch.bool), latents, torch.ones(1, 6, 1)


@pytest.mark.parametrize("norm", ["mse", "l2"])
@pytest.mark.parametrize("solver", ["auto", "lbfgs", "gauss-newton", "papers"])
def test_each_solver_is_the_one_that_was_asked_for(scene, solver, norm, monkeypatch):
    decoder, targets, mask, frames, latents, keep = scene
    called = []
    for name in ("adamw", "lbfgs", "gauss_newton"):
        original = getattr(latent_editing, name)
        monkeypatch.setattr(
            latent_editing, name, lambda *args, n=name, f=original, **kw: called.append(n) or f(*args, **kw)
        )
    objective = ControlObjective(decoder, targets, mask, frames, norm=norm)
    budget = EditingBudget(latent_iterations=3, solver=solver)
    if (solver, norm) == ("gauss-newton", "l2"):
        with pytest.raises(ValueError, match="`solver` 'gauss-newton' needs squared distances"):
            edit_latents(objective, latents, keep, budget)
        return
    edit_latents(objective, latents, keep, budget)
    wanted = {"auto": "gauss_newton" if norm == "mse" else "lbfgs", "gauss-newton": "gauss_newton"}
    assert called == [wanted.get(solver, {"papers": "adamw"}.get(solver, solver))]


@pytest.mark.parametrize("solver", ["auto", "lbfgs"])
def test_a_tolerance_ends_editing_when_it_is_met(scene, solver):
    decoder, targets, mask, frames, latents, keep = scene
    objective = ControlObjective(decoder, targets, mask, frames)
    budget = EditingBudget(latent_iterations=80, solver=solver, tolerance=0.002)
    solution = edit_latents(objective, latents, keep, budget)
    assert solution.reasons == ("target met",)
    assert solution.errors[0][-1] <= 0.002 < solution.errors[0][-2]


def test_lbfgs_goes_on_where_squares_of_metres_look_small(scene):
    """PyTorch's tolerances end it earlier; the targets are those of latents near by."""
    decoder, _, _, frames, latents, keep = scene
    nudge = 0.03 * torch.randn(latents.shape, generator=torch.Generator().manual_seed(0))
    targets = decoder(latents + nudge)
    mask = torch.zeros_like(targets, dtype=torch.bool)
    mask[0, :, [0, 20]] = True
    objective = ControlObjective(decoder, targets, mask, frames)
    usual = lbfgs(objective, latents, keep, Stopping(iterations=100))
    assert usual.reasons == ("converged",)
    solution = edit_latents(objective, latents, keep, EditingBudget(latent_iterations=100, solver="lbfgs"))
    assert solution.errors[0].min() < 0.5 * usual.errors[0].min()


def test_a_time_budget_ends_editing(scene):
    decoder, targets, mask, frames, latents, keep = scene
    objective = ControlObjective(decoder, targets, mask, frames)
    budget = EditingBudget(latent_iterations=10_000, solver="papers", time_budget=0.05)
    solution = edit_latents(objective, latents, keep, budget)
    assert solution.reasons == ("time",)
    assert solution.evaluations[0] < 10_000


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"solver": "newton"}, "`solver` must be one of"),
        ({"tolerance": 0.0}, "`tolerance` must be a positive number or None, got 0.0"),
        ({"time_budget": float("inf")}, "`time_budget` must be a positive number or None, got inf"),
    ],
)
def test_unusable_budgets_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        EditingBudget(**changes)


def test_a_pipeline_meets_its_tolerance(tiny_pipeline):
    plan = Preset(EditingBudget(solver="auto", latent_iterations=60, tolerance=0.001), steps=2)
    control = JointControl("pelvis", frames=[15], positions=[[0.1, 0.9, 0.2]])
    result = tiny_pipeline("a person walks", frames=16, controls=[control], preset=plan)
    assert result.control_error.max() < 0.05
