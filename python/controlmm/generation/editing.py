"""Logits editing inside the decoding steps (ControlMM section 3.4), and how much editing there is in all.

Latents are edited at the end, by ``controlmm.generation.solvers``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.generation.frozen_layers import FrozenMatrix
from controlmm.generation.objective import Objective
from controlmm.generation.solvers.adamw import papers_optimizer
from controlmm.generation.solvers.gradient import plain_gradient
from controlmm.generation.token_mixture import token_mixture

EditingOptimizer = Literal["adamw", "gradient"]
LatentSolver = Literal["papers", "auto", "gauss-newton", "lbfgs"]
_OPTIMIZERS = {"adamw": papers_optimizer, "gradient": plain_gradient}


@dataclass(frozen=True)
class EditingBudget:
    """How editing looks for latents, and how long.

    Attributes:
        solver: "papers" takes the optimiser and the rates below; "gauss-newton", "lbfgs", or "auto", which
            chooses between them, need no rates.
        tolerance: Metres. A clip is done when it is this near its targets.
        time_budget: Seconds for the latents of a batch. Results then depend on the speed of the machine.
        naturalness: Strength of the terms that keep latent editing natural, see ``generation.naturalness``;
            0 leaves them out, 1 is what was chosen on validation clips.
    """

    logits_iterations: int = 0  # in each decoding step
    logits_iterations_grow: bool = False  # step k takes k times as many: the published command's default, 35
    logits_rate: float = 0.06  # of logits editing
    latent_iterations: int = 100  # after the last decoding step
    latent_rate: float = 0.05  # of latent editing, in standard deviations of the base codes
    decays_rate: bool = True  # cosine decay of the latents' rate to zero; the papers keep it constant
    optimizer: EditingOptimizer = "adamw"  # published code; "gradient": plain steps, as the paper writes it

    solver: LatentSolver = "papers"  # of latents
    tolerance: float | None = None
    time_budget: float | None = None
    naturalness: float = 0.0

    def __post_init__(self) -> None:
        if self.logits_iterations < 0 or self.latent_iterations < 0:
            raise ValueError(f"Iterations must not be negative, got {self}.")
        for name in ("logits_rate", "latent_rate"):
            if not getattr(self, name) > 0:
                raise ValueError(f"`{name}` must be positive, got {getattr(self, name)}.")
        if self.optimizer not in _OPTIMIZERS:
            raise ValueError(f"`optimizer` must be one of {tuple(_OPTIMIZERS)}, got {self.optimizer!r}.")

        if self.solver not in get_args(LatentSolver):
            raise ValueError(f"`solver` must be one of {get_args(LatentSolver)}, got {self.solver!r}.")
        if not (math.isfinite(self.naturalness) and self.naturalness >= 0):
            raise ValueError(f"`naturalness` must be a number of at least 0, got {self.naturalness!r}.")
        for name in ("tolerance", "time_budget"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"`{name}` must be a positive number or None, got {value!r}.")

    def logits_iterations_in(self, step: int) -> int:
        """Gradient steps on the logits in decoding step ``step``, counted from 0."""
        return self.logits_iterations * (step + 1 if self.logits_iterations_grow else 1)


def edit_logits(
    logits: Float[Tensor, "B L K"],
    objective: Objective,
    codes: Float[Tensor, "K C"],
    *,
    iterations: int,
    noise: Callable[[], Float[Tensor, "B L K"] | None],
    keep: Float[Tensor, "B L 1"],
    as_printed: bool = False,
    rate: float = 0.06,
    optimizer: EditingOptimizer = "adamw",
) -> Float[Tensor, "B L K"]:
    """Logits moved so that motions sampled from them meet the objective.

    The noise differs from step to step, so that losses cannot be compared and the last iterate is returned.

    Args:
        logits: Base-layer logits.
        objective: What to minimise, on latents ``softmax(logits + noise) @ codes``.
        codes: Base codebook.
        iterations: Gradient steps.
        noise: Draws fresh Gumbel noise for every step; ``None`` means none.
        keep: 1 where a token belongs to a clip, 0 in padding.
        as_printed: As in :func:`token_mixture`.
        rate: Step length; 0.06 is the published one of AdamW.
        optimizer: AdamW or plain gradient steps.
    """
    edited = logits.detach().clone().requires_grad_()
    stepper = _OPTIMIZERS[optimizer](edited, rate)
    of_weights, of_latents = (FrozenMatrix(matrix, None, codes.dtype) for matrix in (codes.T, codes))
    is_done = torch.zeros(len(logits), 1, 1, dtype=torch.bool)
    for _ in range(iterations):
        with torch.enable_grad():
            weights = token_mixture(edited, noise(), as_printed=as_printed)
        latents = of_weights(weights.detach().flatten(0, 1)).unflatten(0, logits.shape[:2]) * keep
        loss, gradient = objective.value_and_gradient(latents)
        is_done |= (loss == 0)[:, None, None]  # whatever others do
        if is_done.all():
            break
        slope = of_latents((gradient * keep).flatten(0, 1)).unflatten(0, logits.shape[:2])
        (edited.grad,) = torch.autograd.grad(weights, edited, slope)
        before = edited.detach().clone()
        stepper.step()
        edited.detach().copy_(before.where(is_done, edited.detach()))
    return edited.detach()
