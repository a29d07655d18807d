"""Runs one search a clip, side by side: a search asks for its next point, a batch of points is evaluated.

A search is a generator that sees one clip only. So its line search, its memory and its end cannot depend on
the clips beside it, and clips that are done leave the batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.generation.joint_progress import Progress
from controlmm.generation.objective import Measured, Objective
from controlmm.generation.one_thread import one_thread
from controlmm.generation.solvers.stopping import Reason, Solution, Stopping, Watch
from controlmm.generation.solvers.unknowns import Unknowns


class Sample(NamedTuple):
    """The objective at one point of one clip."""

    loss: float
    gradient: Float[Tensor, "N"]


Search = Generator[Float[Tensor, "N"], Sample, Reason]


class ClipRecord:
    """One clip on its way: its best iterate, and what led to it."""

    def __init__(self, start: Float[Tensor, "N"]) -> None:
        self.best, self._best_loss = start, math.inf
        self.losses: list[float] = []
        self.errors: list[float] = []
        self.reason: Reason | None = None

    def judge(self, point: Float[Tensor, "N"], loss: float, error: float | None) -> None:
        """Write an evaluation down."""
        self.losses.append(loss)
        if error is not None:
            self.errors.append(error)
        if loss < self._best_loss:
            self.best, self._best_loss = point, loss


def run_searches(
    search: Callable[[Float[Tensor, "N"]], Search],
    objective: Objective,
    latents: Float[Tensor, "B L C"],
    keep: Float[Tensor, "B L 1"],
    stopping: Stopping,
    *,
    progress: Progress | None = None,
) -> Solution:
    """Drive ``search`` from the latents of every clip until each of them stops."""
    unknowns = Unknowns(latents, keep)
    starts = unknowns.starts
    records = [ClipRecord(start) for start in starts]
    watch = Watch(stopping)
    searches = {row: search(start) for row, start in enumerate(starts)}
    points = {row: next(running) for row, running in searches.items()}
    selected, rows = objective, list(points)
    while points:
        if rows != list(points):
            rows = list(points)
            selected = objective.select(torch.tensor(rows))
        losses, slopes = selected.value_and_gradient(unknowns.placed(list(points.values()), rows))
        gradients = unknowns.gradients(slopes, rows)
        errors = selected.errors().tolist() if isinstance(selected, Measured) else [None] * len(rows)
        for row, loss, error, gradient in zip(rows, losses.tolist(), errors, gradients, strict=True):
            record = records[row]
            record.judge(points.pop(row), loss, error)
            record.reason = watch.verdict(loss=loss, error=error, evaluations=len(record.losses))
            if record.reason is None:
                try:
                    with one_thread():
                        points[row] = searches[row].send(Sample(loss, gradient))
                except StopIteration as stop:
                    record.reason = stop.value
        report(progress, max(len(record.losses) for record in records), stopping)
    return solution_of(records, unknowns, watch)


def report(progress: Progress | None, evaluations: int, stopping: Stopping) -> None:
    """Tell the caller how many steps are done; the first evaluation only judges the start."""
    limits = [limit for limit in (stopping.iterations, stopping.evaluations) if limit is not None]
    if progress is not None and evaluations > 1:
        total = min(limits, default=evaluations)
        progress("codebook editing", min(evaluations - 1, total), total)


def solution_of(records: list[ClipRecord], unknowns: Unknowns, watch: Watch) -> Solution:
    """The best iterates and what led to them."""
    return Solution(
        latents=unknowns.placed([record.best for record in records], range(len(records))),
        losses=tuple(torch.tensor(record.losses) for record in records),
        errors=tuple(torch.tensor(record.errors) for record in records),
        evaluations=torch.tensor([len(record.losses) for record in records], dtype=torch.int64),
        reasons=tuple(record.reason or "converged" for record in records),
        seconds=watch.seconds,
    )
