"""The first part of a clip's way to its targets, on which the motion's naturalness counts.

Targets are pulled at with a force that grows with their distance, naturalness pulls back, and where both are
in balance targets are not yet met. So the targets are then shifted by what is left, again and again (the
method of multipliers: Nocedal and Wright, chapter 17.3), which lets them win without a large factor that
would spoil the steps.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.generation.control_residuals import Probe

_FEW = 45  # coordinates: a pose of fifteen joints, a joint at fifteen keyframes
# Of the natural part; later ones improved little on validation clips.
_STEPS_OF_FEW, _STEPS = 5, 15
_BALANCED = 0.1  # squared gradient below this share of what the residual would push with when alone


def natural_steps(coordinates: int, iterations: int | None) -> int:
    """Steps of the natural part towards so many controlled coordinates, at most half of all ``iterations``.

    A few targets hardly fight with the feet.
    """
    steps = _STEPS if coordinates > _FEW else _STEPS_OF_FEW
    return steps if iterations is None else min(steps, iterations // 2)


class NaturalWay:
    """What the natural part adds to the residual of one clip.

    Args:
        start: The unknowns at the start.
        nearness: Weight of the squared way from there.
        steps: After so many the rest goes the shortest way.
    """

    def __init__(self, start: Float[Tensor, "N"], *, nearness: float, steps: int) -> None:
        self._start, self._nearness, self._steps = start, nearness, steps
        self._shift: Tensor | None = None
        self._is_balanced = False

    def ends(self, steps: int) -> bool:
        """Whether it is over after so many."""
        return steps >= self._steps

    def shifted(self, residual: Float[Tensor, "R"]) -> Float[Tensor, "R"]:
        """The residual to targets as they are shifted."""
        return residual if self._shift is None else residual + self._shift

    def shift(self, residual: Float[Tensor, "R"]) -> bool:
        """Shift the targets by what is left, if forces are in balance; says whether it did."""
        if not self._is_balanced:
            return False
        self._shift, self._is_balanced = self.shifted(residual), False
        return True

    def value(self, probe: Probe, point: Float[Tensor, "N"]) -> float:
        """Strain and nearness."""
        way = point - self._start
        return probe.strain + 0.5 * self._nearness * (way @ way).item()

    def slope(self, point: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
        """Gradient of nearness."""
        return self._nearness * (point - self._start)

    def see(self, gradient: Float[Tensor, "N"], push: float) -> None:
        """Compare the gradient of everything with the squared force of the residual alone."""
        self._is_balanced = torch.dot(gradient, gradient).item() < _BALANCED * push
