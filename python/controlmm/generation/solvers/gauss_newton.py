"""Gauss-Newton with minimum-norm steps: as few evaluations as editing can take.

The step ``J^T (J J^T + damping)^-1 r`` moves the latents least of all that remove the residual, and so stays
nearest to what the networks made. Its matrix is not built from the decoder's Jacobian, which would cost a
backward pass for every controlled coordinate, but from what the decoder's Jacobian is on average (see
``sensitivity``) and the exact Jacobian of the kinematics. So a step is one pass forward and one back. What
the average leaves is learned along the way, as by L-BFGS, in the metric that makes all residuals alike.
Lengths of steps are measured in standard deviations of the codes (``code_spread``).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.generation.control_residuals import ControlResiduals, Probe
from controlmm.generation.joint_progress import Progress
from controlmm.generation.one_thread import one_thread
from controlmm.generation.solvers.clip_search import ClipRecord, report, solution_of
from controlmm.generation.solvers.curvature import Curvature
from controlmm.generation.solvers.known_rows import MOST_ROWS, KnownRows, ShortestWay
from controlmm.generation.solvers.metric import Metric
from controlmm.generation.solvers.natural_way import NaturalWay, natural_steps
from controlmm.generation.solvers.stopping import Reason, Solution, Stopping, Watch
from controlmm.generation.solvers.unknowns import Unknowns

_EARLY_RENEWALS, _STEPS_OF_A_METRIC = (2, 5), 10  # steps after which a metric may be made anew
_STALE = 0.1  # metres of the way or radians of the heading: by so much less, an old metric is as good
_HISTORY = 20
_SUFFICIENT_DECREASE = 1e-4
_MOST_HALVINGS = 8
_FLAT = 1e-6  # a slope below this share of the value leads nowhere in float32


def gauss_newton(
    residuals: ControlResiduals,
    latents: Float[Tensor, "B L C"],
    keep: Float[Tensor, "B L 1"],
    stopping: Stopping,
    *,
    progress: Progress | None = None,
) -> Solution:
    """Latents that meet the targets, near where they started; each clip keeps its best iterate.

    Args:
        residuals: What should vanish.
        latents: Where to start.
        keep: 1 where a token may change, 0 in padding and where it is held fixed.
        stopping: Limits; an evaluation is one pass forward, with a pass back where one is needed. A clip's
            own Jacobian is not counted.
        progress: Called after every evaluation.
    """
    unknowns = Unknowns(latents, keep, residuals.spread)
    starts = unknowns.starts
    records = [ClipRecord(start) for start in starts]
    descents = [
        _Descent(start, residuals, stopping.iterations, coordinates=count)
        for start, count in zip(starts, residuals.coordinates, strict=True)
    ]
    watch = Watch(stopping)
    selected, active = residuals, list(range(len(records)))
    while active:
        wanted: list[Tensor | None] = []
        probes = selected.probe(unknowns.placed([descents[row].point for row in active], active))
        for place, (row, probe) in enumerate(zip(active, probes, strict=True)):
            record, descent = records[row], descents[row]
            error = (3 * probe.loss) ** 0.5
            record.judge(descent.point, probe.loss, error)
            record.reason = watch.verdict(loss=probe.loss, error=error, evaluations=len(record.losses))
            wanted.append(descent.see(probe) if record.reason is None else None)
            if descent.asks_for_rows:
                slopes = selected.jacobian(place, probe)
                descent.know(torch.stack(unknowns.gradients(slopes, [row] * len(slopes))), probe)
        if any(weights is not None for weights in wanted):
            slopes = selected.pull(wanted, strained=[descents[row].is_natural for row in active])
            gradients = unknowns.gradients(slopes, active)
            for row, weights, gradient in zip(active, wanted, gradients, strict=True):
                if weights is not None:
                    descents[row].turn(gradient)
        for row in active:
            records[row].reason = records[row].reason or descents[row].reason
        still = [row for row in active if records[row].reason is None]
        if still != active:
            active, selected = still, residuals.select(torch.tensor(still, dtype=torch.int64))
        report(progress, max(len(record.losses) for record in records), stopping)
    return solution_of(records, unknowns, watch)


class _Descent:
    """The way of one clip: asks for ``point``, sees what is there, turns by the gradient."""

    def __init__(
        self,
        start: Float[Tensor, "N"],
        residuals: ControlResiduals,
        iterations: int | None,
        *,
        coordinates: int,
    ) -> None:
        self.point = start
        self.reason: Reason | None = None
        self._origin, self._direction, self._step = start, torch.zeros_like(start), 1.0
        self._residuals, self._iterations, self._done = residuals, iterations, -1
        self._memory = Curvature(_HISTORY)
        self._metric: Metric | None = None
        self._shortest: ShortestWay | None = None
        self._may_know, self.asks_for_rows = 0 < coordinates <= MOST_ROWS, False
        self._way = start.new_zeros(0, 3)
        self._value, self._slope = math.inf, 0.0
        self._gradient: Tensor | None = None
        self._halvings = 0
        self._push = 0.0  # squared length of the step that the residual alone asks for
        self._natural: NaturalWay | None = None
        if residuals.naturalness is not None:
            nearness, steps = residuals.naturalness.weights.nearness, natural_steps(coordinates, iterations)
            self._natural = NaturalWay(start, nearness=nearness, steps=steps)

    @property
    def is_natural(self) -> bool:
        """Whether the strain of the motion counts."""
        return self._natural is not None

    @one_thread()
    def know(self, rows: Float[Tensor, "R N"], probe: Probe) -> None:
        """The clip's own Jacobian where the natural part has ended: the rest goes by it."""
        known = KnownRows(rows)
        known.bend(self._memory)
        self._memory.clear()
        self._may_know = self.asks_for_rows = False
        self._shortest = ShortestWay(known, self.point, probe)
        self._go_by(self._shortest)

    @one_thread()
    def see(self, probe: Probe) -> Float[Tensor, "N"] | None:
        """Weights of the gradient wanted here; ``None`` if the next point needs none."""
        if self._shortest is not None:
            self._follow(self._shortest, probe)
            return None
        if self._metric is None:
            self._renew(probe)
        assert self._metric is not None
        value, weights = self._weigh(probe)
        if not value <= self._value + _SUFFICIENT_DECREASE * self._step * self._slope:
            self._shorten(value)
            return None
        self._done += 1
        if self._is_stale(probe):
            self._renew(probe)
            value, weights = self._weigh(probe)
        if self._natural is not None and self._natural.ends(self._done):
            self._go_straight()
            value, weights = self._weigh(probe)
        elif self._natural is not None and self._natural.shift(probe.residual):
            value, weights = self._weigh(probe)
            self._gradient = None
        if self._natural is None and self._may_know:
            self.asks_for_rows = True
            return None
        self._value = value
        if self._natural is not None:
            self._push = 2 * self._metric.weigh(probe.residual)[0]
        return weights

    def _follow(self, way: ShortestWay, probe: Probe) -> None:
        """A step by known rows. Where they lead no further: new ones if they helped, else the average."""
        self._done += 1
        if way.see(self.point, probe):
            self._go_by(way)
        else:
            self._shortest, self._value, self.point = None, math.inf, way.best
            self._may_know = way.has_helped

    def _go_by(self, way: ShortestWay) -> None:
        if self._iterations is not None and self._done >= self._iterations:
            self.reason = "iterations"
        else:
            self.point = way.next()

    def _weigh(self, probe: Probe) -> tuple[float, Float[Tensor, "N"]]:
        """What is minimised, and the weights of the residual in its gradient."""
        assert self._metric is not None
        if self._natural is None:
            return self._metric.weigh(probe.residual)
        value, weights = self._metric.weigh(self._natural.shifted(probe.residual))
        return value + self._natural.value(probe, self.point), weights

    @one_thread()
    def turn(self, gradient: Float[Tensor, "N"]) -> None:
        """Choose where to go from the latest point."""
        if self._natural is not None:
            gradient = gradient + self._natural.slope(self.point)
            self._natural.see(gradient, self._push)
        if self._gradient is not None:
            self._memory.add(self.point - self._origin, gradient - self._gradient)
        if self._iterations is not None and self._done >= self._iterations:
            self.reason = "iterations"
            return
        self._origin, self._gradient = self.point, gradient
        self._direction = self._memory.direction(gradient)
        self._slope = (gradient @ self._direction).item()
        if self._slope >= -_FLAT * self._value:
            self._end()
            return
        self._step, self._halvings = 1.0, 0
        self.point = self._origin + self._direction

    def _end(self) -> None:
        """No step is left; after the natural part, the shortest way may still have some."""
        if self._natural is None:
            self.reason = "converged"
            return
        self._go_straight()
        self._value, self.point = math.inf, self._origin

    def _go_straight(self) -> None:
        """From here on targets alone count."""
        self._natural, self._gradient = None, None
        if not self._may_know:  # else it says where the motion is stiff
            self._memory.clear()

    def _is_stale(self, probe: Probe) -> bool:
        """Whether an average metric should be made anew: by and by, if the root has moved."""
        is_due = self._done in _EARLY_RENEWALS or (self._done and self._done % _STEPS_OF_A_METRIC == 0)
        return bool(is_due) and bool((_way(probe) - self._way).abs().max() > _STALE)

    def _renew(self, probe: Probe) -> None:
        """The metric of the clip as it now is; gradients of the old one cannot be compared with new ones."""
        self._way = _way(probe)
        self._metric = Metric(self._residuals.gram(probe), probe.view.groups)
        self._memory.clear()
        self._gradient = None

    def _shorten(self, value: float) -> None:
        """Go back towards the origin, to the minimum of the parabola through what is known of the line."""
        self._halvings += 1
        if self._halvings > _MOST_HALVINGS:
            self._end()
            return
        excess = value - self._value - self._slope * self._step
        best = -0.5 * self._slope * self._step**2 / excess if excess > 0 else 0.0
        self._step = min(max(best, 0.1 * self._step), 0.5 * self._step)
        self.point = self._origin + self._step * self._direction


def _way(probe: Probe) -> Float[Tensor, "T 3"]:
    """Where the root is on the ground in metres, and its heading in radians."""
    heading = 2 * probe.features[:, :1].cumsum(0)
    return torch.cat([probe.joints[:, 0, [0, 2]] * probe.metres, heading], dim=1)
