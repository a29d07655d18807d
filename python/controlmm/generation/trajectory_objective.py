"""What TLControl's test-time optimisation minimises (equation 4): the paper's form and the released one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from controlmm.generation.clip_sums import clip_sums
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.objective import ControlObjective, Objective
from controlmm.generation.terms import JointTerm
from controlmm.ops import masked_consistency_loss

LossForm = Literal["half_square", "smooth_l1", "norm_sum"]
LOSS_FORMS = ("half_square", "smooth_l1", "norm_sum")


def trajectory_objective(
    form: LossForm,
    decoder: MotionDecoder,
    targets: Float[Tensor, "B T J 3"],
    mask: Bool[Tensor, "B T J 3"],
    frames: Bool[Tensor, "B T"],
    *,
    terms: Sequence[JointTerm] = (),
) -> Objective:
    """The objective on latents, one value a clip.

    Args:
        form: ``smooth_l1`` is the released code's mean over the controlled coordinates. ``half_square``
            equals it where no coordinate is off by more than 1 m, so that tolerances mean the same, and
            runs in the fused kernel. ``norm_sum`` is the paper's sum of distances of all controlled points.
        decoder: Latents to joints.
        targets: Metres, the networks' frame.
        mask: The controlled coordinates.
        frames: The frames of each clip.
        terms: What is added. ``half_square`` halves them too: they are weighed against a mean square.

    Raises:
        ValueError: If there is no such form.
    """
    if form == "half_square":
        square = ControlObjective(decoder, targets, mask, frames, terms=terms)
        return Rescaled(square, loss_factor=0.5)
    if form not in LOSS_FORMS:
        raise ValueError(f"`form` must be one of {', '.join(LOSS_FORMS)}, got {form!r}.")
    return JointwiseObjective(_LOSSES[form], decoder, targets, mask, frames, terms)


class Rescaled:
    """Another objective with its loss times a factor and its latents in another unit.

    L-BFGS ends on slopes and steps, so that a tolerance means something for one unit of the latents only.
    """

    def __init__(self, objective: Objective, *, loss_factor: float = 1.0, unit: float = 1.0) -> None:
        self._objective, self._loss_factor, self._unit = objective, loss_factor, unit

    def value_and_gradient(
        self, latents: Float[Tensor, "B L C"]
    ) -> tuple[Float[Tensor, "B"], Float[Tensor, "B L C"]]:
        """See :class:`Objective`; ``latents`` times the unit are what the decoder takes."""
        loss, gradient = self._objective.value_and_gradient(latents * self._unit)
        return self._loss_factor * loss, self._loss_factor * self._unit * gradient

    def select(self, clips: Int[Tensor, "S"]) -> Rescaled:
        """See :class:`Objective`."""
        selected = self._objective.select(clips)
        return Rescaled(selected, loss_factor=self._loss_factor, unit=self._unit)


class JointwiseObjective:
    """A loss of joints and targets by autograd: for forms that the fused kernel does not have."""

    def __init__(
        self,
        loss: JointLoss,
        decoder: MotionDecoder,
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        frames: Bool[Tensor, "B T"],
        terms: Sequence[JointTerm],
    ) -> None:
        self._loss, self._decoder, self._terms = loss, decoder, tuple(terms)
        self._targets, self._mask, self._frames = targets, mask, frames

    @torch.enable_grad()
    def value_and_gradient(
        self, latents: Float[Tensor, "B L C"]
    ) -> tuple[Float[Tensor, "B"], Float[Tensor, "B L C"]]:
        """See :class:`Objective`."""
        latents = latents.detach().requires_grad_()
        joints = self._decoder(latents, self._frames)
        loss = self._loss(joints, self._targets, self._mask)
        loss = loss + sum(term.values(joints) for term in self._terms)
        (gradient,) = torch.autograd.grad(loss.sum(), latents)
        return loss.detach(), gradient

    def select(self, clips: Int[Tensor, "S"]) -> JointwiseObjective:
        """See :class:`Objective`."""
        return JointwiseObjective(
            self._loss,
            self._decoder,
            self._targets[clips],
            self._mask[clips],
            self._frames[clips],
            [term.select(clips) for term in self._terms],
        )


def _smooth_l1(joints: Tensor, targets: Tensor, mask: Tensor) -> Tensor:
    losses = smooth_l1_loss(joints, targets, reduction="none") * mask
    return clip_sums(losses) / mask.flatten(1).sum(1).clamp(min=1)


def _mean_distance(joints: Tensor, targets: Tensor, mask: Tensor) -> Tensor:
    return masked_consistency_loss(joints, targets, mask, norm="l2", reduction="clip")


def _norm_sum(joints: Tensor, targets: Tensor, mask: Tensor) -> Tensor:
    return _mean_distance(joints, targets, mask) * mask.any(-1).flatten(1).sum(1)


JointLoss = Callable[[Tensor, Tensor, Tensor], Tensor]  # joints, targets, mask -> one value a clip
_LOSSES: dict[str, JointLoss] = {"smooth_l1": _smooth_l1, "norm_sum": _norm_sum}
