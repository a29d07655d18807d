"""Logits editing inside the decoding steps (ControlMM section 3.4), or what takes its place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from controlmm.generation.control_residuals import ControlResiduals
from controlmm.generation.controlled_layers import without_base
from controlmm.generation.decoding_request import DecodingRequest
from controlmm.generation.editing import EditingBudget, EditingOptimizer
from controlmm.generation.frozen_matrix import FrozenMatrix
from controlmm.generation.objective import ControlObjective, Objective
from controlmm.generation.observed_logits import observed_logits
from controlmm.generation.solvers.adamw import papers_optimizer
from controlmm.generation.solvers.gradient import plain_gradient
from controlmm.generation.token_mixture import token_mixture
from controlmm.models.tokenizer import MotionTokenizer

_OPTIMIZERS = {"adamw": papers_optimizer, "gradient": plain_gradient}


@dataclass(frozen=True)
class LogitsEditing:
    """When, how often and by what rules the base logits of a batch are edited."""

    objective: Objective
    tokenizer: MotionTokenizer
    request: DecodingRequest
    budget: EditingBudget

    @property
    def ends_with_all_layers(self) -> bool:
        """Whether the last step's editing waits for the residual layers, see :meth:`with_all_layers`."""
        is_wanted = self.request.rules.last_edit == "all_layers"
        return is_wanted and self.budget.logits_iterations > 0

    def within(self, logits: Float[Tensor, "B L K"], step: int) -> Float[Tensor, "B L K"]:
        """Logits of decoding step ``step``, observed or edited, unless the last ones have to wait."""
        if self.budget.observes_targets:
            return self._observed(logits)
        if self.ends_with_all_layers and step == self.request.steps - 1:
            return logits
        return self._edited(logits, step)

    def with_all_layers(
        self, logits: Float[Tensor, "B L K"], ids: Int[Tensor, "B L Q"]
    ) -> Float[Tensor, "B L K"]:
        """The last logits, edited as the base of a motion that has the residual layers of ``ids``.

        These layers lead the motion on, away from its targets by more than editing without them had left.
        """
        finer = self.tokenizer.quantizer.lookup(without_base(ids))
        return self._edited(logits, self.request.steps - 1, finer)

    def _observed(self, logits: Float[Tensor, "B L K"]) -> Float[Tensor, "B L K"]:
        """Of clips that lead more than their root, whose way asks for few other poses.

        Not beside terms, which are no sums of squares: obstacles would be forgotten.
        """
        if self._residuals is None:
            return logits
        rows, residuals = self._residuals
        keep = self.request.drawn[rows, :, None].to(logits.dtype)
        found = observed_logits(logits[rows], residuals, self.tokenizer.base_codes, keep)
        return logits.index_copy(0, rows, found)

    @cached_property
    def _residuals(self) -> tuple[Int[Tensor, "N"], ControlResiduals] | None:
        """The clips that are observed, and what should vanish of theirs."""
        objective = self.objective
        if not isinstance(objective, ControlObjective):
            return None
        rows = objective.mask[:, :, 1:].flatten(1).any(1).nonzero()[:, 0]
        residuals = objective.select(rows).residuals() if len(rows) else None
        return None if residuals is None else (rows, residuals)

    def _edited(self, logits: Tensor, step: int, finer: Tensor | float = 0.0) -> Tensor:
        iterations, rules = self.budget.logits_iterations_in(step), self.request.rules
        if not iterations:
            return logits
        codes = self.tokenizer.base_codes
        return edit_logits(
            logits,
            self.objective,
            codes,
            iterations=iterations,
            noise=lambda: None if rules.editing_noise == "none" else self.request.gumbel(len(codes)),
            keep=self.request.valid[..., None].float(),
            finer=finer,
            as_printed=rules.editing_noise == "as_printed",
            rate=self.budget.logits_rate,
            optimizer=self.budget.optimizer,
        )


def edit_logits(
    logits: Float[Tensor, "B L K"],
    objective: Objective,
    codes: Float[Tensor, "K C"],
    *,
    iterations: int,
    noise: Callable[[], Float[Tensor, "B L K"] | None],
    keep: Float[Tensor, "B L 1"],
    finer: Float[Tensor, "B L C"] | float = 0.0,
    as_printed: bool = False,
    rate: float = 0.06,
    optimizer: EditingOptimizer = "adamw",
) -> Float[Tensor, "B L K"]:
    """Logits moved so that motions sampled from them meet the objective.

    The noise differs from step to step, so that losses cannot be compared and the last iterate is returned.

    Args:
        logits: Base-layer logits.
        objective: What to minimise, on latents ``softmax(logits + noise) @ codes + finer``.
        codes: Base codebook.
        iterations: Gradient steps.
        noise: Draws fresh Gumbel noise for every step; ``None`` means none.
        keep: 1 where a token belongs to a clip, 0 in padding.
        finer: Latents of the residual layers; the published code edits without any.
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
        latents = of_weights(weights.detach().flatten(0, 1)).unflatten(0, logits.shape[:2]) * keep + finer
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
