"""What editing minimises: the distance of the decoded joints to their targets."""

from __future__ import annotations

from typing import Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.ops import masked_consistency_loss


class Objective(Protocol):
    """A differentiable function of code-space latents, one value a clip."""

    def value_and_gradient(
        self, latents: Float[Tensor, "B L C"]
    ) -> tuple[Float[Tensor, "B"], Float[Tensor, "B L C"]]:
        """Losses of the clips, and the gradient of their sum. No clip's numbers depend on another's."""


class ControlObjective:
    """Mean squared error of each clip's controlled coordinates in m^2 (MaskControl's inference loss).

    Args:
        decoder: Latents to joints.
        targets: (B, T, J, 3) metres.
        mask: (B, T, J, 3), the controlled coordinates.
        frames: (B, T), the frames of each clip.
    """

    def __init__(
        self,
        decoder: MotionDecoder,
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        frames: Bool[Tensor, "B T"],
    ) -> None:
        self.decoder = decoder
        self.targets, self.mask = targets, mask
        self.frames = None if frames.all() else frames

    def value_and_gradient(
        self, latents: Float[Tensor, "B L C"]
    ) -> tuple[Float[Tensor, "B"], Float[Tensor, "B L C"]]:
        """See :class:`Objective`."""
        with torch.enable_grad():
            latents = latents.detach().requires_grad_()
            joints = self.decoder(latents, self.frames)
            loss = masked_consistency_loss(joints, self.targets, self.mask, norm="mse", reduction="clip")
            (gradient,) = torch.autograd.grad(loss.sum(), latents)
        return loss.detach(), gradient


def control_error(
    joints: Float[Tensor, "B T J 3"], targets: Float[Tensor, "B T J 3"], mask: Bool[Tensor, "B T J 3"]
) -> Float[Tensor, "B"]:
    """Mean distance in metres of controlled joints to their targets, measured along their controlled axes.

    0 for a clip without targets.
    """
    return masked_consistency_loss(joints, targets, mask, norm="l2", reduction="clip")
