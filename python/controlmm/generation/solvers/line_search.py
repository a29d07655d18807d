"""Line search for the strong Wolfe conditions: bracketing, then zooming by cubic interpolation.

Source: Nocedal and Wright, "Numerical Optimization", algorithms 3.5 and 3.6, with the safeguards that
PyTorch's L-BFGS has, so that tolerances mean the same here and there.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from controlmm.generation.solvers.clip_search import Sample

SUFFICIENT_DECREASE, CURVATURE = 1e-4, 0.9  # c1 and c2
MAX_EVALUATIONS = 25
_NARROWEST = 1e-9  # of a bracket, times the direction's largest entry
_EDGE = 0.1  # share of a bracket at its ends that interpolation may use only once in a row


class Trial(NamedTuple):
    """The objective at one step along the line."""

    step: float
    loss: float
    slope: float  # directional derivative
    gradient: Float[Tensor, "N"]


LineSearch = Generator[Float[Tensor, "N"], Sample, Trial]


class Line:
    """Points ``origin + step * direction``, and what is wanted of them."""

    def __init__(self, origin: Float[Tensor, "N"], direction: Float[Tensor, "N"], start: Sample) -> None:
        self._origin, self._direction = origin, direction
        self.start = Trial(0.0, start.loss, self._slope(start.gradient), start.gradient)
        self.reach = direction.abs().max().item()
        self.evaluations = 0

    def _slope(self, gradient: Tensor) -> float:
        return (gradient @ self._direction).item()

    def point(self, step: float) -> Float[Tensor, "N"]:
        """Where ``step`` leads."""
        return self._origin.add(self._direction, alpha=step)

    def evaluate(self, step: float) -> LineSearch:
        """Ask for the objective at ``step``."""
        sample = yield self.point(step)
        self.evaluations += 1
        return Trial(step, sample.loss, self._slope(sample.gradient), sample.gradient)

    def is_too_high(self, trial: Trial) -> bool:
        """Whether the loss falls less than the first Wolfe condition asks."""
        limit = self.start.loss + SUFFICIENT_DECREASE * trial.step * self.start.slope
        return not trial.loss <= limit  # so that NaN is too high

    def is_flat(self, trial: Trial) -> bool:
        """Whether the slope meets the second Wolfe condition."""
        return abs(trial.slope) <= -CURVATURE * self.start.slope


def strong_wolfe(line: Line, first_step: float) -> LineSearch:
    """The first trial that meets both conditions, or the lowest one after 25 evaluations."""
    before, trial = line.start, (yield from line.evaluate(first_step))
    while line.evaluations <= MAX_EVALUATIONS:
        is_rising = line.evaluations > 2 and trial.loss >= before.loss
        if line.is_too_high(trial) or is_rising:
            return (yield from _zoom(line, before, trial))
        if line.is_flat(trial):
            return trial
        if trial.slope >= 0:
            return (yield from _zoom(line, before, trial))
        farther = trial.step + 0.01 * (trial.step - before.step), 10 * trial.step
        step = cubic_minimum(before, trial, bounds=farther)
        before, trial = trial, (yield from line.evaluate(step))
    return min(line.start, trial, key=lambda candidate: candidate.loss)


def _zoom(line: Line, first: Trial, second: Trial) -> LineSearch:
    """Narrow a bracket that holds a point with both conditions; the better end stays ``low``."""
    low, high = sorted((first, second), key=lambda trial: trial.loss)
    was_at_edge = False
    while line.evaluations <= MAX_EVALUATIONS and abs(high.step - low.step) * line.reach >= _NARROWEST:
        left, right = sorted((low.step, high.step))
        step = cubic_minimum(*sorted((low, high), key=lambda trial: trial.step), bounds=(left, right))
        margin = _EDGE * (right - left)
        is_at_edge = min(right - step, step - left) < margin
        if is_at_edge and (was_at_edge or step in (left, right)):
            step = right - margin if right - step < step - left else left + margin
            is_at_edge = False
        was_at_edge = is_at_edge
        trial = yield from line.evaluate(step)
        if line.is_too_high(trial) or trial.loss >= low.loss:
            low, high = sorted((low, trial), key=lambda end: end.loss)
            continue
        if line.is_flat(trial):
            return trial
        if trial.slope * (high.step - low.step) >= 0:
            high = low
        low = trial
    return low


def cubic_minimum(first: Trial, second: Trial, *, bounds: tuple[float, float]) -> float:
    """Where the cubic through two trials (``first`` at the smaller step) is lowest, inside ``bounds``.

    The middle of the bounds where that cubic has no minimum.
    """
    width = second.step - first.step
    bend = first.slope + second.slope - 3 * (first.loss - second.loss) / (first.step - second.step)
    square = bend * bend - first.slope * second.slope
    if not square >= 0:
        return 0.5 * (bounds[0] + bounds[1])
    root = math.sqrt(square)
    span = second.slope - first.slope + 2 * root
    if span == 0:
        return 0.5 * (bounds[0] + bounds[1])
    step = second.step - width * ((second.slope + root - bend) / span)
    return min(max(step, bounds[0]), bounds[1])
