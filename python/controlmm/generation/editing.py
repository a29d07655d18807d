"""Logits editing inside the decoding steps (ControlMM section 3.4), and how much editing there is in all.

Latents are edited at the end, by ``controlmm.generation.solvers``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.generation.objective import Objective
from controlmm.generation.solvers.adamw import papers_optimizer


@dataclass(frozen=True)
class EditingBudget:
    """How many gradient steps editing may take."""

    logits_iterations: int = 0  # in each decoding step
    latent_iterations: int = 100  # after the last decoding step
    latent_rate: float = 0.05  # of latent editing, in standard deviations of the base codes
    decays_rate: bool = True  # cosine decay of the latents' rate to zero; the papers keep it constant

    def __post_init__(self) -> None:
        if self.logits_iterations < 0 or self.latent_iterations < 0:
            raise ValueError(f"Iterations must not be negative, got {self}.")
        if not self.latent_rate > 0:
            raise ValueError(f"`latent_rate` must be positive, got {self.latent_rate}.")


def edit_logits(
    logits: Float[Tensor, "B L K"],
    objective: Objective,
    codes: Float[Tensor, "K C"],
    *,
    iterations: int,
    noise: Callable[[], Float[Tensor, "B L K"]],
    keep: Float[Tensor, "B L 1"],
) -> Float[Tensor, "B L K"]:
    """Logits moved so that motions sampled from them meet the objective.

    The noise differs from step to step, so that losses cannot be compared and the last iterate is returned.

    Args:
        logits: Base-layer logits.
        objective: What to minimise, on latents ``softmax(logits + noise) @ codes``.
        codes: Base codebook.
        iterations: Gradient steps (AdamW).
        noise: Draws fresh Gumbel noise for every step.
        keep: 1 where a token belongs to a clip, 0 in padding.
    """
    edited = logits.detach().clone().requires_grad_()
    optimizer = papers_optimizer(edited)
    for _ in range(iterations):
        with torch.enable_grad():
            latents = (torch.softmax(edited + noise(), dim=-1) @ codes) * keep
        loss, gradient = objective.value_and_gradient(latents)
        if not loss.any():
            break
        (edited.grad,) = torch.autograd.grad(latents, edited, gradient)
        optimizer.step()
    return edited.detach()
