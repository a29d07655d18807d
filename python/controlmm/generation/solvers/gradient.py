"""Plain gradient steps, as the paper writes its editing (ControlMM, equation 7)."""

from __future__ import annotations

from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.generation.joint_progress import Progress
from controlmm.generation.objective import Objective
from controlmm.generation.solvers.clip_search import Search, run_searches
from controlmm.generation.solvers.stopping import Reason, Solution, Stopping


def plain_gradient(variable: Tensor, rate: float) -> torch.optim.Optimizer:
    """Steps of ``rate`` times the gradient."""
    return torch.optim.SGD([variable], lr=rate)


def gradient_descent(
    objective: Objective,
    latents: Float[Tensor, "B L C"],
    keep: Float[Tensor, "B L 1"],
    stopping: Stopping,
    *,
    rate: float,
    progress: Progress | None = None,
) -> Solution:
    """Latents after ``stopping.iterations`` steps against the gradient; each clip keeps its best iterate.

    Args:
        objective: What to minimise.
        latents: Where to start.
        keep: 1 where a token may change, 0 in padding and where it is held fixed.
        stopping: ``iterations`` is required.
        rate: Step length for a gradient of 1.
        progress: Called after every evaluation.

    Raises:
        ValueError: If ``stopping`` does not say how many iterations.
    """
    if stopping.iterations is None:
        raise ValueError("`gradient_descent` needs `stopping.iterations`.")
    search = partial(_search, iterations=stopping.iterations, rate=rate)
    return run_searches(search, objective, latents, keep, stopping, progress=progress)


def _search(start: Float[Tensor, "N"], *, iterations: int, rate: float) -> Search:
    point = start.clone()
    for _ in range(iterations):
        sample = yield point.clone()
        point = point - rate * sample.gradient
    yield point
    reason: Reason = "iterations"
    return reason
