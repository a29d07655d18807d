"""Editing of latents at the end of generation: which solver runs, and how long."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from jaxtyping import Float
from torch import Tensor

from controlmm.generation.editing import EditingBudget
from controlmm.generation.naturalness import NaturalWeights
from controlmm.generation.objective import ControlObjective
from controlmm.generation.solvers import (
    LbfgsTolerance,
    Progress,
    Solution,
    Stopping,
    adamw,
    gauss_newton,
    gradient_descent,
    lbfgs,
)

_LBFGS_STEPS = 4  # for each step of Gauss-Newton, which costs as much and looks further ahead
_NATURAL_SHARE = 0.4  # of the steps of L-BFGS
_MILLIMETRE = 1e-3  # metres
_FIRST_REACH = 0.1  # of the first trial of L-BFGS, in standard deviations of the base codes


def edit_latents(
    objective: ControlObjective,
    latents: Float[Tensor, "B L C"],
    keep: Float[Tensor, "B L 1"],
    budget: EditingBudget,
    *,
    progress: Progress | None = None,
) -> Solution:
    """Latents that meet the objective as well as ``budget`` allows.

    Args:
        objective: Targets of the clips.
        latents: Where to start.
        keep: 1 where a token may change, 0 in padding and where it is held fixed.
        budget: Solver and limits. ``auto`` takes Gauss-Newton for squared distances to targets and L-BFGS for
            everything else, with four steps where Gauss-Newton would take one. With ``naturalness``, the
            motion of ``latents`` is what editing is compared with.
        progress: Called after every evaluation.
    """
    plain = objective
    if budget.naturalness:
        objective = objective.kept_natural(latents, NaturalWeights().times(budget.naturalness))
    unit = 1 / objective.decoder.normalizer.skeleton.metres
    stopping = Stopping(
        error=None if budget.tolerance is None else budget.tolerance * unit,
        iterations=budget.latent_iterations,
        milliseconds=None if budget.time_budget is None else 1000 * budget.time_budget,
    )
    if budget.solver == "papers":
        rate = budget.latent_rate * objective.decoder.code_deviation()
        if budget.optimizer == "gradient":
            return gradient_descent(objective, latents, keep, stopping, rate=rate, progress=progress)
        decays = budget.decays_rate
        return adamw(objective, latents, keep, stopping, rate=rate, decays_rate=decays, progress=progress)
    residuals = objective.residuals()
    if budget.solver == "gauss-newton" and residuals is None:
        raise ValueError(
            "`solver` 'gauss-newton' needs squared distances to targets of a residual tokenizer. Use 'lbfgs' "
            "or 'auto'."
        )
    if budget.solver == "auto" and residuals is None:
        stopping = replace(stopping, iterations=_LBFGS_STEPS * budget.latent_iterations)
    if budget.solver == "lbfgs" or residuals is None:
        return _lbfgs(objective, plain, latents, keep, stopping, progress)
    return gauss_newton(residuals, latents, keep, stopping, progress=progress)


def _lbfgs(
    natural: ControlObjective,
    plain: ControlObjective,
    latents: Float[Tensor, "B L C"],
    keep: Float[Tensor, "B L 1"],
    stopping: Stopping,
    progress: Progress | None,
) -> Solution:
    """The first part of the way is natural; what is then left of the error goes the shortest way."""
    search = partial(
        lbfgs,
        keep=keep,
        tolerance=_square_millimetres(plain),
        first_reach=_FIRST_REACH * plain.decoder.code_deviation(),
        progress=progress,
    )
    if natural is plain or stopping.iterations is None:
        return search(natural, latents, stopping=stopping)
    steps = round(_NATURAL_SHARE * stopping.iterations)
    first = search(natural, latents, stopping=replace(stopping, iterations=steps))
    spent = 1000 * first.seconds
    if stopping.milliseconds is not None and spent >= stopping.milliseconds:
        return first
    left = replace(
        stopping,
        iterations=stopping.iterations - steps,
        milliseconds=None if stopping.milliseconds is None else stopping.milliseconds - spent,
    )
    return first.then(search(plain, first.latents, stopping=left))


def _square_millimetres(objective: ControlObjective) -> LbfgsTolerance:
    """PyTorch's tolerances, which are for losses of order one: in m^2 a millimetre is a millionth."""
    usual = LbfgsTolerance()
    factor = (_MILLIMETRE / objective.decoder.normalizer.skeleton.metres) ** 2
    return LbfgsTolerance(gradient=factor * usual.gradient, change=factor * usual.change)
