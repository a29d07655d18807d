"""A clip's own Jacobian, for so few controlled coordinates that each may have a pass back.

The passes go through the decoder together and share its weights: a row costs a fifth of an evaluation.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.generation.control_residuals import Probe
from controlmm.generation.solvers.curvature import Curvature

MOST_ROWS = 18  # six joints in one frame, one joint in six: more rows cost more evaluations than they save
_DAMPING = 1e-3  # times the mean of the diagonal of J J^T
_PROGRESS, _FAILURES = 0.5, 3  # after so many steps that leave more than half, rows are not worth following
_SHORTER = 0.25  # times the step that has led away
_HELPED = 0.9  # of the loss at their beginning: rows that came below it are worth making anew


class KnownRows:
    """The Jacobian of the clip itself, and the shortest steps by it.

    Args:
        rows: (N, U) gradients of the residual's coordinates in the unknowns.
    """

    def __init__(self, rows: Float[Tensor, "N U"]) -> None:
        self._rows, self._ways = rows, rows

    def learn(self, step: Float[Tensor, "U"], change: Float[Tensor, "N"]) -> None:
        """Correct the rows by what a step changed (Broyden's update: Nocedal and Wright, chapter 11.1)."""
        length = (step @ step).item()
        if length > 0:
            surprise = change.float() - self._rows @ step
            self._rows = self._rows.addr(surprise / length, step)

    def bend(self, memory: Curvature) -> None:
        """From here on steps avoid directions that are stiff by ``memory``, that of the natural part."""
        self._ways = torch.stack([-memory.direction(row) for row in self._rows])

    def step(self, residual: Float[Tensor, "N"]) -> Float[Tensor, "U"]:
        """The shortest step that removes the residual, up to damping."""
        products = self._rows.double() @ self._ways.double().T
        diagonal = products.diagonal()
        diagonal += _DAMPING * diagonal.mean() + torch.finfo(torch.float32).tiny
        weights, _ = torch.linalg.solve_ex(products, residual)
        step: Tensor = -weights.float() @ self._ways
        return step


class ShortestWay:
    """The end of a clip's way by known rows: passes forward only, each of which corrects the rows."""

    def __init__(self, rows: KnownRows, point: Float[Tensor, "U"], probe: Probe) -> None:
        self.best, self._rows = point, rows
        self._residual, self._loss, self._failures = probe.residual, probe.loss, 0
        self._first, self._share = probe.loss, 1.0

    def see(self, point: Float[Tensor, "U"], probe: Probe) -> bool:
        """Take the point if it is better; says whether to go on."""
        self._rows.learn(point - self.best, probe.residual - self._residual)
        self._failures += not probe.loss < _PROGRESS * self._loss
        if probe.loss < self._loss:
            self.best, self._residual, self._loss = point, probe.residual, probe.loss
            self._share = 1.0
        else:
            self._share *= _SHORTER
        return self._failures < _FAILURES

    @property
    def has_helped(self) -> bool:
        """Whether the way has come nearer than where it began."""
        return self._loss < _HELPED * self._first

    def next(self) -> Float[Tensor, "U"]:
        """Where to go."""
        return self.best + self._share * self._rows.step(self._residual)
