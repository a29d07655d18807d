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

from controlmm.generation.code_spread import CodeSpread
from controlmm.generation.joint_progress import Progress
from controlmm.generation.objective import Measured, Objective
from controlmm.generation.one_thread import one_thread
from controlmm.generation.solvers.stopping import Reason, Solution, Stopping, Watch


class Sample(NamedTuple):
    """The objective at one point of one clip."""

    loss: float
    gradient: Float[Tensor, "N"]


Search = Generator[Float[Tensor, "N"], Sample, Reason]


class ClipRecord:
    """One clip on its way: its unknowns and its best iterate.

    Unknown are the latents of the tokens that may change or, given a ``spread``, their changes in its unit.
    """

    def __init__(
        self, latents: Float[Tensor, "L C"], keep: Float[Tensor, "L 1"], spread: CodeSpread | None = None
    ) -> None:
        self.is_free, self._spread = keep[:, 0] > 0, spread
        self.start: Tensor = latents[self.is_free].flatten()
        if spread is not None:
            self.start = torch.zeros_like(self.start)
        self._best, self._best_loss = self.start, math.inf
        self.losses: list[float] = []
        self.errors: list[float] = []
        self.reason: Reason | None = None

    def judge(self, point: Tensor, loss: float, error: float | None) -> None:
        """Write an evaluation down."""
        self.losses.append(loss)
        if error is not None:
            self.errors.append(error)
        if loss < self._best_loss:
            self._best, self._best_loss = point, loss

    @one_thread()
    def placed(self, point: Tensor, latents: Float[Tensor, "L C"]) -> Float[Tensor, "L C"]:
        """``latents`` with the unknowns replaced by ``point``."""
        placed, rows = latents.clone(), point.unflatten(0, (-1, latents.shape[-1]))
        placed[self.is_free] = (
            rows if self._spread is None else latents[self.is_free] + self._spread.change(rows)
        )
        return placed

    @one_thread()
    def gradient(self, gradient: Float[Tensor, "L C"]) -> Float[Tensor, "N"]:
        """The gradient in the unknowns, given that in the latents."""
        rows = gradient[self.is_free]
        return (rows if self._spread is None else self._spread.gradient(rows)).flatten()

    def best_in(self, latents: Float[Tensor, "L C"]) -> Float[Tensor, "L C"]:
        """``latents`` with the best iterate in its place."""
        return self.placed(self._best, latents)


def run_searches(
    search: Callable[[Float[Tensor, "N"]], Search],
    objective: Objective,
    latents: Float[Tensor, "B L C"],
    keep: Float[Tensor, "B L 1"],
    stopping: Stopping,
    *,
    spread: CodeSpread | None = None,
    progress: Progress | None = None,
) -> Solution:
    """Drive ``search`` from the latents of every clip until each of them stops."""
    latents = latents.detach()
    records = [ClipRecord(clip, kept, spread) for clip, kept in zip(latents, keep, strict=True)]
    watch = Watch(stopping)
    searches = {row: search(record.start) for row, record in enumerate(records)}
    points = {row: next(running) for row, running in searches.items()}
    selected, rows = objective, list(points)
    while points:
        if rows != list(points):
            rows = list(points)
            selected = objective.select(torch.tensor(rows))
        batch = torch.stack([records[row].placed(point, latents[row]) for row, point in points.items()])
        losses, gradients = selected.value_and_gradient(batch)
        errors = selected.errors().tolist() if isinstance(selected, Measured) else [None] * len(rows)
        for row, loss, error, gradient in zip(rows, losses.tolist(), errors, gradients, strict=True):
            record = records[row]
            record.judge(points.pop(row), loss, error)
            record.reason = watch.verdict(loss=loss, error=error, evaluations=len(record.losses))
            if record.reason is None:
                try:
                    with one_thread():
                        points[row] = searches[row].send(Sample(loss, record.gradient(gradient)))
                except StopIteration as stop:
                    record.reason = stop.value
        report(progress, max(len(record.losses) for record in records), stopping)
    return solution_of(records, latents, watch)


def report(progress: Progress | None, evaluations: int, stopping: Stopping) -> None:
    """Tell the caller how many steps are done; the first evaluation only judges the start."""
    limits = [limit for limit in (stopping.iterations, stopping.evaluations) if limit is not None]
    if progress is not None and evaluations > 1:
        total = min(limits, default=evaluations)
        progress("codebook editing", min(evaluations - 1, total), total)


def solution_of(records: list[ClipRecord], latents: Float[Tensor, "B L C"], watch: Watch) -> Solution:
    """The best iterates and what led to them."""
    if not records:
        return Solution(latents, (), (), torch.zeros(0, dtype=torch.int64), (), watch.seconds)
    return Solution(
        latents=torch.stack([record.best_in(clip) for record, clip in zip(records, latents, strict=True)]),
        losses=tuple(torch.tensor(record.losses) for record in records),
        errors=tuple(torch.tensor(record.errors) for record in records),
        evaluations=torch.tensor([len(record.losses) for record in records]),
        reasons=tuple(record.reason or "converged" for record in records),
        seconds=watch.seconds,
    )
