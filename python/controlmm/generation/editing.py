"""Editing by gradient: logits inside the decoding steps, latents at the end (ControlMM section 3.4)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.generation.objective import Objective

Progress = Callable[[str, int, int], None]  # phase, steps done, steps in all

_LOGITS_RATE, _BETAS, _WEIGHT_DECAY = 0.06, (0.5, 0.9), 1e-6


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

    Args:
        logits: Base-layer logits.
        objective: What to minimise, on latents ``softmax(logits + noise) @ codes``.
        codes: Base codebook.
        iterations: Gradient steps (AdamW).
        noise: Draws fresh Gumbel noise for every step.
        keep: 1 where a token belongs to a clip, 0 in padding.
    """
    edited = logits.detach().clone().requires_grad_()
    optimizer = _optimizer(edited, _LOGITS_RATE)
    for _ in range(iterations):
        with torch.enable_grad():
            latents = (torch.softmax(edited + noise(), dim=-1) @ codes) * keep
        loss, gradient = objective.value_and_gradient(latents)
        if not loss.any():
            break
        (edited.grad,) = torch.autograd.grad(latents, edited, gradient)
        optimizer.step()
    return edited.detach()


def edit_latents(
    latents: Float[Tensor, "B L C"],
    objective: Objective,
    *,
    iterations: int,
    rate: float = 0.06,
    decays_rate: bool,
    keep: Float[Tensor, "B L 1"],
    progress: Progress | None = None,
) -> tuple[Float[Tensor, "B L C"], Float[Tensor, "I B"]]:
    """Latents moved so that the decoded motion meets the objective; each clip keeps its best iterate.

    Args:
        latents: Where to start.
        objective: What to minimise.
        iterations: Gradient steps (AdamW).
        rate: Learning rate; 0.06 is the papers', for their codes. It should go with the codes' spread.
        decays_rate: Let the rate fall to zero along a cosine, which ends nearer the targets.
        keep: 1 where a token belongs to a clip, 0 in padding.
        progress: Called after every step.

    Returns:
        The latents, and the loss of every clip at every evaluation.
    """
    edited = latents.detach().clone().requires_grad_()
    optimizer = _optimizer(edited, rate)
    best, best_loss = latents.detach().clone(), torch.full((len(latents),), math.inf)
    history = []
    for step in range(iterations + 1):  # the last evaluation only judges the last step
        loss, gradient = objective.value_and_gradient(edited)
        history.append(loss)
        better = loss < best_loss
        best_loss = torch.where(better, loss, best_loss)
        best = torch.where(better[:, None, None], edited.detach(), best)
        if step == iterations or not loss.any():
            break
        if decays_rate:
            optimizer.param_groups[0]["lr"] = rate * 0.5 * (1 + math.cos(math.pi * step / iterations))
        edited.grad = gradient * keep
        optimizer.step()
        if progress is not None:
            progress("codebook editing", step + 1, iterations)
    return best, torch.stack(history)


def _optimizer(variable: Tensor, rate: float) -> torch.optim.Optimizer:
    return torch.optim.AdamW([variable], lr=rate, betas=_BETAS, weight_decay=_WEIGHT_DECAY)
