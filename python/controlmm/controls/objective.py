"""Any differentiable function of the joints as something to minimise."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real

import torch
from jaxtyping import Float
from torch import Tensor

JointFunction = Callable[[Float[Tensor, "B T J 3"]], Float[Tensor, "*B"]]


@dataclass(frozen=True, eq=False)
class Objective:
    """A function of the joints that editing makes small, beside targets and obstacles.

    Example:
        >>> def hands_together(joints):  # (B, T, J, 3) metres, Y up
        ...     return (joints[:, :, 20] - joints[:, :, 21]).square().sum(-1).mean(1)  # (B,)
        >>> Objective(hands_together, weight=1.0)

    Attributes:
        fn: Takes joints (B, T, J, 3) in the world of the controls, metres, exactly the frames of the clips,
            and returns (B,) values, smaller is better, or one scalar, for which it is called with a single
            clip. No clip's value may depend on another's. It must be made of differentiable torch operations.
        weight: Factor. Targets count with their mean squared error in m^2 a coordinate, so 0.01 weighs as
            much as targets missed by 10 cm.
        name: What messages call it.
    """

    fn: JointFunction
    weight: float = 1.0
    name: str = ""

    def __post_init__(self) -> None:
        if not callable(self.fn):
            raise TypeError(f"`fn` must be callable, got {type(self.fn).__name__}.")
        if isinstance(self.weight, bool) or not isinstance(self.weight, Real):
            raise TypeError(f"`weight` must be a number, got {type(self.weight).__name__}.")
        if not (math.isfinite(self.weight) and self.weight > 0):
            raise ValueError(f"`weight` must be positive and finite, got {self.weight}.")
        if not self.name:
            object.__setattr__(self, "name", getattr(self.fn, "__name__", "objective"))

    @torch.enable_grad()
    def check(self, joints: Float[Tensor, "B T J 3"]) -> bool:
        """Try ``fn`` on two or more clips; true if it gives a value for each, false if one for all.

        Raises:
            TypeError: If it returns something that is no tensor.
            ValueError: If the shape is wrong, a value or gradient is NaN or infinite, there is no gradient,
                or a clip's value depends on another clip.
        """
        trial = joints.detach().clone().requires_grad_()
        is_batched = self._checked_values(trial).ndim == 1
        values = self._checked_values(trial if is_batched else trial[:1])
        (gradient,) = torch.autograd.grad(
            values if values.ndim == 0 else values[0], trial, allow_unused=True, materialize_grads=True
        )
        if not gradient.isfinite().all():
            raise ValueError(
                f"The gradient of objective {self.name!r} is NaN or infinite on a standing pose. A square "
                "root or a norm of zero does that: add a small number inside."
            )
        if is_batched and gradient[1:].any():
            raise ValueError(
                f"Objective {self.name!r} mixes clips: the value of the first depends on the second. "
                "Reduce over frames and joints only, or return a scalar."
            )
        return is_batched

    def values(self, joints: Float[Tensor, "B T J 3"], *, is_batched: bool) -> Float[Tensor, "B"]:
        """Weighted values of clips of one length."""
        if is_batched:
            return self.weight * self.fn(joints)
        return self.weight * torch.stack([self.fn(clip[None]).reshape(()) for clip in joints])

    def _checked_values(self, joints: Tensor) -> Tensor:
        values = self.fn(joints)
        if not isinstance(values, Tensor):
            raise TypeError(f"Objective {self.name!r} must return a tensor, got {type(values).__name__}.")
        if values.shape not in ((), (len(joints),)):
            raise ValueError(
                f"Objective {self.name!r} must return shape (B,) = ({len(joints)},) or a scalar, "
                f"got {tuple(values.shape)}."
            )
        if not values.detach().isfinite().all():
            raise ValueError(f"Objective {self.name!r} gives NaN or infinity on a standing pose.")
        if not values.requires_grad:
            raise ValueError(
                f"Objective {self.name!r} has no gradient: its value does not depend on the joints through "
                "torch operations. Avoid numpy(), detach(), comparisons, argmax and .item()."
            )
        return values
