"""What L-BFGS remembers: pairs of steps and changes of the gradient (Nocedal and Wright, algorithm 7.4)."""

from __future__ import annotations

from collections import deque

from jaxtyping import Float
from torch import Tensor

_LEAST_CURVATURE = 1e-10  # of a pair that may enter; less would make the inverse Hessian indefinite


class Curvature:
    """An approximate inverse Hessian of one clip."""

    def __init__(self, history: int) -> None:
        self._pairs: deque[tuple[Tensor, Tensor, float]] = deque(maxlen=history)  # step, change, 1 / product
        self._scale = 1.0

    def __len__(self) -> int:
        return len(self._pairs)

    def add(self, step: Float[Tensor, "N"], change: Float[Tensor, "N"]) -> None:
        """Learn from a step and the change of the gradient along it; does nothing where it is concave."""
        product = (step @ change).item()
        if product > _LEAST_CURVATURE:
            self._pairs.append((step, change, 1 / product))
            self._scale = product / (change @ change).item()

    def clear(self) -> None:
        """Forget everything; the inverse Hessian is the identity again."""
        self._pairs.clear()
        self._scale = 1.0

    def direction(self, gradient: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
        """Minus the inverse Hessian times ``gradient`` (the two-loop recursion)."""
        direction = -gradient
        weights = []
        for step, change, inverse in reversed(self._pairs):
            weight = inverse * (step @ direction).item()
            direction = direction.sub(change, alpha=weight)
            weights.append(weight)
        direction = direction * self._scale
        for (step, change, inverse), weight in zip(self._pairs, reversed(weights), strict=True):
            direction = direction.add(step, alpha=weight - inverse * (change @ direction).item())
        return direction
