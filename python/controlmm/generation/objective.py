"""What editing minimises: the distance of the decoded joints to their targets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.terms import JointTerm
from controlmm.ops import frames_last, guidance_value_and_grad, masked_consistency_loss, recover_joints
from controlmm.ops.consistency import Norm


class Objective(Protocol):
    """A differentiable function of code-space latents, one value a clip."""

    def value_and_gradient(
        self, latents: Float[Tensor, "B L C"]
    ) -> tuple[Float[Tensor, "B"], Float[Tensor, "B L C"]]:
        """Losses of the clips, and the gradient of their sum. No clip's numbers depend on another's."""

    def select(self, clips: Int[Tensor, "S"]) -> Objective:
        """The same for some of the clips, so that those that are done leave the batch."""


@runtime_checkable
class Measured(Protocol):
    """An objective that knows how far the clips are from their targets."""

    def errors(self) -> Float[Tensor, "B"]:
        """Metres, at the latest evaluation."""


class ControlObjective:
    """Error of each clip's controlled coordinates, by default their mean square in m^2 (MaskControl's loss).

    Args:
        decoder: Latents to joints.
        targets: (B, T, J, 3) metres.
        mask: (B, T, J, 3), the controlled coordinates.
        frames: (B, T), the frames of each clip.
        norm: As in :func:`controlmm.ops.masked_consistency_loss`; the paper's words are "l2".
        terms: What is added to the error, such as obstacles.
    """

    def __init__(
        self,
        decoder: MotionDecoder,
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        frames: Bool[Tensor, "B T"],
        *,
        norm: Norm = "mse",
        terms: Sequence[JointTerm] = (),
    ) -> None:
        self.decoder, self.norm = decoder, norm
        self.targets, self.mask = frames_last(targets), frames_last(mask)
        self.frames = None if frames.all() else frames
        self.terms = tuple(terms)
        self._loss = torch.zeros(len(targets))
        self._gradient: Tensor | None = None  # of the decoder's output, written again at every evaluation

    def value_and_gradient(
        self, latents: Float[Tensor, "B L C"]
    ) -> tuple[Float[Tensor, "B"], Float[Tensor, "B L C"]]:
        """See :class:`Objective`."""
        statistics = self.decoder.normalizer
        with torch.enable_grad():
            latents = latents.detach().requires_grad_()
            decoded = self.decoder.tokenizer.decode_channels(latents, self.frames)
        loss, self._gradient = guidance_value_and_grad(
            decoded.detach(),
            self.targets,
            self.mask,
            mean=statistics.mean,
            std=statistics.std,
            norm=self.norm,
            out=self._gradient,
        )
        if self.terms:
            values, slope = self._terms_and_gradient(decoded.detach())
            loss = loss + values
            self._gradient += slope
        (gradient,) = torch.autograd.grad(decoded, latents, self._gradient)
        self._loss = loss
        return loss, gradient

    def select(self, clips: Int[Tensor, "S"]) -> ControlObjective:
        """See :class:`Objective`."""
        frames = torch.ones(self.mask.shape[:2], dtype=torch.bool) if self.frames is None else self.frames
        return ControlObjective(
            self.decoder,
            self.targets[clips],
            self.mask[clips],
            frames[clips],
            norm=self.norm,
            terms=[term.select(clips) for term in self.terms],
        )

    def errors(self) -> Float[Tensor, "B"]:
        """At least the mean distance of the controlled points in metres, at the latest evaluation.

        By the mean square it is the root mean square distance; points with a free axis count as if their
        distance were larger by at most the square root of 3. Terms count as errors: a clip inside an obstacle
        is not done.
        """
        if self.norm == "l2":
            return self._loss
        return (3 * self._loss).sqrt() if self.norm == "mse" else 3 * self._loss

    @torch.enable_grad()
    def _terms_and_gradient(
        self, decoded: Float[Tensor, "B D T"]
    ) -> tuple[Float[Tensor, "B"], Float[Tensor, "B D T"]]:
        statistics = self.decoder.normalizer
        decoded.requires_grad_()
        features = statistics.denormalize(decoded.transpose(1, 2))
        joints = recover_joints(features, joints=statistics.skeleton.num_joints)
        values = torch.stack([term.values(joints) for term in self.terms]).sum(0)
        (slope,) = torch.autograd.grad(values.sum(), decoded)
        return values.detach(), slope


def control_error(
    joints: Float[Tensor, "B T J 3"], targets: Float[Tensor, "B T J 3"], mask: Bool[Tensor, "B T J 3"]
) -> Float[Tensor, "B"]:
    """Mean distance in metres of controlled joints to their targets, measured along their controlled axes.

    0 for a clip without targets.
    """
    return masked_consistency_loss(joints, targets, mask, norm="l2", reduction="clip")
