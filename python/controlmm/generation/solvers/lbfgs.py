"""L-BFGS with a strong Wolfe line search, clip by clip on batched evaluations.

TLControl optimises its codes so (Wan et al., ECCV 2024); their tolerance, the "accuracy" of their tables, is
``change`` here.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.generation.joint_progress import Progress
from controlmm.generation.objective import Objective
from controlmm.generation.solvers.clip_search import Sample, Search, run_searches
from controlmm.generation.solvers.curvature import Curvature
from controlmm.generation.solvers.line_search import Line, strong_wolfe
from controlmm.generation.solvers.stopping import Reason, Solution, Stopping


@dataclass(frozen=True)
class LbfgsTolerance:
    """When L-BFGS sees no use in going on; the names say what PyTorch's mean.

    Attributes:
        gradient: Largest entry of the gradient (``tolerance_grad``).
        change: Stops on a directional derivative above minus this, a step whose largest entry is at most
            this, or a loss that changes by less (``tolerance_change``). TLControl's 1e-4 to 1e-8.
    """

    gradient: float = 1e-7
    change: float = 1e-9


def lbfgs(
    objective: Objective,
    latents: Float[Tensor, "B L C"],
    keep: Float[Tensor, "B L 1"],
    stopping: Stopping,
    *,
    rate: float = 1.0,
    history: int = 200,
    tolerance: LbfgsTolerance | None = None,
    first_reach: float | None = None,
    progress: Progress | None = None,
) -> Solution:
    """Latents that minimise the objective; each clip keeps its best iterate.

    Every clip has its own line search and memory, so that its result does not depend on its batch.

    Args:
        objective: What to minimise.
        latents: Where to start.
        keep: 1 where a token may change, 0 in padding and where it is held fixed.
        stopping: Limits; without ``iterations`` the others end it.
        rate: First trial of every line search; in the first one, ``min(1, 1 / |g|_1)`` times that.
            TLControl's is 0.1.
        history: Pairs to remember; each costs two vectors as long as the latents of a clip.
        tolerance: When to stop for want of progress.
        first_reach: By how much the very first trial changes the entry that it changes most; ``None`` is
            PyTorch's rule, whose trial is lost in rounding where gradients are small.
        progress: Called after every evaluation.
    """
    steps: list[int] = []
    search = partial(
        _search,
        steps=steps,
        iterations=stopping.iterations,
        rate=rate,
        history=history,
        tolerance=tolerance or LbfgsTolerance(),
        first_reach=first_reach,
    )
    solution = run_searches(search, objective, latents, keep, stopping, progress=progress)
    return dataclasses.replace(solution, iterations=torch.tensor(steps, dtype=torch.int64))


def _search(
    start: Float[Tensor, "N"],
    *,
    steps: list[int],
    iterations: int | None,
    rate: float,
    history: int,
    tolerance: LbfgsTolerance,
    first_reach: float | None,
) -> Search:
    """The search of the next clip; how many steps it has taken stands in a new place of ``steps``."""
    converged: Reason = "converged"
    point, memory = start, Curvature(history)
    clip = len(steps)
    steps.append(0)
    sample = yield point
    if sample.gradient.abs().max() <= tolerance.gradient:
        return converged
    step = _first_step(sample, rate, first_reach)
    while iterations is None or steps[clip] < iterations:
        direction = memory.direction(sample.gradient)
        line = Line(point, direction, sample)
        if line.start.slope > -tolerance.change:
            return converged
        reached = yield from strong_wolfe(line, step)
        steps[clip] += 1
        moved, change = direction * reached.step, reached.gradient - sample.gradient
        is_still = moved.abs().max() <= tolerance.change
        if is_still or abs(reached.loss - sample.loss) < tolerance.change:
            return converged
        point = line.point(reached.step)
        sample = sample._replace(loss=reached.loss, gradient=reached.gradient)
        if sample.gradient.abs().max() <= tolerance.gradient:
            return converged
        memory.add(moved, change)
        step = rate
    reason: Reason = "iterations"
    return reason


def _first_step(sample: Sample, rate: float, reach: float | None) -> float:
    if reach is None:
        return min(1.0, 1 / sample.gradient.abs().sum().item()) * rate
    return reach / sample.gradient.abs().max().item()
