"""What residual layers see of the targets when they are filled in under control."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.generation.kept_tokens import KeptTokens
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.partial_decoder import PartialDecoder, controlled_joints
from controlmm.models.residual_control import ResidualControl


@dataclass(frozen=True)
class ControlledLayers:
    """A batch's targets, and the base layer that they are to be reached from."""

    network: ResidualControl
    decoder: MotionDecoder
    targets: Float[Tensor, "B T J 3"]  # global, in the skeleton's unit
    mask: Bool[Tensor, "B T J 3"]
    base: Float[Tensor, "B L C"]  # latents of the base layer, which may be a mean of codes
    kept: KeptTokens | None = None  # of a motion that is there
    strength: float = 1.0  # of the speed that would bring what is missing
    part: PartialDecoder | None = None  # says where joints are, instead of the decoder; see `quick`

    def quick(self, frames: Bool[Tensor, "B T"], dtype: torch.dtype) -> ControlledLayers:
        """The same without gradients: only joints that count are decoded, with products in ``dtype``."""
        joints = sorted({*controlled_joints(self.mask), *self.decoder.normalizer.skeleton.facing})
        return replace(self, part=PartialDecoder(self.decoder, joints, frames, dtype=dtype))

    def hints(
        self, ids: Int[Tensor, "B L Q"], layer: Int[Tensor, "B"], valid: Bool[Tensor, "B L"]
    ) -> list[Float[Tensor, "B L W"]]:
        """For the residual transformer that predicts ``layer``; ``ids`` are -1 in layers that are to come."""
        if self.kept is not None:
            ids = self.kept.put_back(ids)
        latents = self.base + self.decoder.tokenizer.quantizer.lookup(without_base(ids))
        if self.part is None:
            current = self.decoder(latents, valid.repeat_interleave(self.decoder.downsample, dim=1))
        else:
            current = self.part.positions(latents)
        signal = self.network.signal(self.targets, self.mask, current, strength=self.strength)
        hints: list[Tensor] = self.network(signal, layer, valid)
        return hints


def without_base(ids: Int[Tensor, "B L Q"]) -> Int[Tensor, "B L Q"]:
    """The codes of the residual layers; -1, which stands for no code, in the base layer."""
    return torch.cat([torch.full_like(ids[..., :1], -1), ids[..., 1:]], dim=-1)
