"""What editing minimises: the distance of the decoded joints to their targets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.generation.control_residuals import ControlResiduals
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.naturalness import Naturalness, NaturalWeights
from controlmm.generation.partial_decoder import PartialDecoder, controlled_joints
from controlmm.generation.terms import JointTerm
from controlmm.models.rvq_vae import RvqVae
from controlmm.ops import frames_last, guidance_value_and_grad, masked_consistency_loss, recover_joints
from controlmm.ops.consistency import Norm

STRAIN_WEIGHT = 1e-4  # m^2 of squared error for each unit of naturalness lost


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
        naturalness: What is weighed against the error.
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
        naturalness: Naturalness | None = None,
    ) -> None:
        self.targets, self.mask = targets, mask
        self.decoder, self.frames, self.norm = decoder, frames, norm
        self.terms, self.naturalness = tuple(terms), naturalness
        self._part = PartialDecoder(decoder, self._joints(), frames)
        joints = list(self._part.joints)
        self._wanted = frames_last(targets[:, :, joints]), frames_last(mask[:, :, joints])
        self._loss = torch.zeros(len(targets))
        self._gradient: Tensor | None = None  # of the decoder's output, written again at every evaluation

    def value_and_gradient(
        self, latents: Float[Tensor, "B L C"]
    ) -> tuple[Float[Tensor, "B"], Float[Tensor, "B L C"]]:
        """See :class:`Objective`."""
        part = self._part
        decoded = part.decode(latents.detach())
        self._loss, self._gradient = guidance_value_and_grad(
            decoded.features.mT,
            *self._wanted,
            mean=part.mean,
            std=part.std,
            norm=self.norm,
            out=self._gradient,
        )
        if not self.terms and self.naturalness is None:
            return self._loss, part.pull(decoded, self._gradient.mT)
        values, strain, slope = self._terms_and_gradient(decoded.features)
        self._loss = self._loss + values
        self._gradient += slope.mT
        return self._loss + strain, part.pull(decoded, self._gradient.mT)

    def select(self, clips: Int[Tensor, "S"]) -> ControlObjective:
        """See :class:`Objective`."""
        return ControlObjective(
            self.decoder,
            self.targets[clips],
            self.mask[clips],
            self.frames[clips],
            norm=self.norm,
            terms=[term.select(clips) for term in self.terms],
            naturalness=None if self.naturalness is None else self.naturalness.select(clips),
        )

    def kept_natural(self, latents: Float[Tensor, "B L C"], weights: NaturalWeights) -> ControlObjective:
        """The same with the terms of naturalness for editing that starts from ``latents``."""
        naturalness = Naturalness.of_start(self.decoder, latents, self.mask, self.frames, weights)
        return ControlObjective(
            self.decoder,
            self.targets,
            self.mask,
            self.frames,
            norm=self.norm,
            terms=self.terms,
            naturalness=naturalness,
        )

    def residuals(self) -> ControlResiduals | None:
        """The same as a sum of squares, for Gauss-Newton; ``None`` if it is none that Gauss-Newton knows."""
        if self.terms or self.norm != "mse" or not isinstance(self.decoder.tokenizer, RvqVae):
            return None
        return ControlResiduals(
            self.decoder, self.targets, self.mask, self.frames, naturalness=self.naturalness
        )

    def errors(self) -> Float[Tensor, "B"]:
        """At least the mean distance of the controlled points in metres, at the latest evaluation.

        By the mean square it is the root mean square distance; points with a free axis count as if their
        distance were larger by at most the square root of 3. Terms count as errors: a clip inside an obstacle
        is not done. Naturalness does not.
        """
        if self.norm == "l2":
            return self._loss
        return (3 * self._loss).sqrt() if self.norm == "mse" else 3 * self._loss

    def _joints(self) -> tuple[int, ...]:
        """Terms see all joints, distances to targets only those that have some."""
        if self.terms or self.naturalness is not None:
            return tuple(range(self.targets.shape[2]))
        return controlled_joints(self.mask)

    @torch.enable_grad()
    def _terms_and_gradient(
        self, decoded: Float[Tensor, "B T D"]
    ) -> tuple[Float[Tensor, "B"], Float[Tensor, "B"], Float[Tensor, "B T D"]]:
        """Terms, weighed naturalness, and the gradient of both."""
        decoded = decoded.requires_grad_()
        features = decoded * self._part.std + self._part.mean
        joints = recover_joints(features, joints=len(self._part.joints))
        nothing = joints.new_zeros(len(joints))
        values = sum((term.values(joints) for term in self.terms), nothing)
        strain = nothing
        if self.naturalness is not None:
            strain = STRAIN_WEIGHT * self.naturalness.values(features, joints)
        (slope,) = torch.autograd.grad((values + strain).sum(), decoded)
        return values.detach(), strain.detach(), slope


def control_error(
    joints: Float[Tensor, "B T J 3"], targets: Float[Tensor, "B T J 3"], mask: Bool[Tensor, "B T J 3"]
) -> Float[Tensor, "B"]:
    """Mean distance in metres of controlled joints to their targets, measured along their controlled axes.

    0 for a clip without targets.
    """
    return masked_consistency_loss(joints, targets, mask, norm="l2", reduction="clip")
