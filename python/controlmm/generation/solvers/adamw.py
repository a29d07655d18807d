"""AdamW, the papers' optimiser of editing: the reference that every other solver is compared with."""

from __future__ import annotations

import math
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.generation.joint_progress import Progress
from controlmm.generation.objective import Objective
from controlmm.generation.solvers.clip_search import Search, run_searches
from controlmm.generation.solvers.stopping import Reason, Solution, Stopping

_RATE, _BETAS, _WEIGHT_DECAY = 0.06, (0.5, 0.9), 1e-6


def papers_optimizer(variable: Tensor, rate: float = _RATE) -> torch.optim.Optimizer:
    """AdamW with MaskControl's settings; their rate suits their codes and their logits."""
    return torch.optim.AdamW([variable], lr=rate, betas=_BETAS, weight_decay=_WEIGHT_DECAY)


def adamw(
    objective: Objective,
    latents: Float[Tensor, "B L C"],
    keep: Float[Tensor, "B L 1"],
    stopping: Stopping,
    *,
    rate: float = _RATE,
    decays_rate: bool = False,
    progress: Progress | None = None,
) -> Solution:
    """Latents after ``stopping.iterations`` steps of AdamW; each clip keeps its best iterate.

    Args:
        objective: What to minimise.
        latents: Where to start.
        keep: 1 where a token may change, 0 in padding and where it is held fixed.
        stopping: ``iterations`` is required; the evaluation after the last step only judges it.
        rate: Learning rate; it should go with the codes' spread.
        decays_rate: Let the rate fall to zero along a cosine, which ends nearer the targets.
        progress: Called after every evaluation.

    Raises:
        ValueError: If ``stopping`` does not say how many iterations.
    """
    if stopping.iterations is None:
        raise ValueError("`adamw` needs `stopping.iterations`: its rate may depend on them.")
    search = partial(_search, iterations=stopping.iterations, rate=rate, decays_rate=decays_rate)
    return run_searches(search, objective, latents, keep, stopping, progress=progress)


def _search(start: Float[Tensor, "N"], *, iterations: int, rate: float, decays_rate: bool) -> Search:
    variable = start.clone().requires_grad_()
    optimizer = papers_optimizer(variable, rate)
    for step in range(iterations):
        sample = yield variable.detach().clone()
        if decays_rate:
            optimizer.param_groups[0]["lr"] = rate * 0.5 * (1 + math.cos(math.pi * step / iterations))
        variable.grad = sample.gradient
        optimizer.step()
    yield variable.detach().clone()
    reason: Reason = "iterations"
    return reason
