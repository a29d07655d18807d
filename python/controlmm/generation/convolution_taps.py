"""Convolutions over time written as other ones that say the same with fewer products."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn


@dataclass(frozen=True, eq=False)
class Taps:
    """Weights of a convolution of odd width; float64, for they are summed.

    Attributes:
        weight: (out, in, width).
        bias: (out,).
    """

    weight: Float[Tensor, "out in width"]
    bias: Float[Tensor, "out"]

    @classmethod
    def of(cls, conv: nn.Conv1d) -> Taps:
        """Those of a layer that neither strides nor dilates."""
        assert conv.bias is not None
        assert conv.stride == conv.dilation == (1,)
        return cls(conv.weight.detach().double(), conv.bias.detach().double())

    def then(self, other: Taps) -> Taps:
        """One convolution in place of two. At the ends of a clip it sees the first one's result go on."""
        width = self.weight.shape[2] + other.weight.shape[2] - 1
        weight = self.weight.new_zeros(len(other.weight), self.weight.shape[1], width)
        for place, tap in enumerate(other.weight.unbind(2)):
            weight[..., place : place + self.weight.shape[2]] += torch.einsum("om,mik->oik", tap, self.weight)
        return Taps(weight, other.bias + other.weight.sum(2) @ self.bias)

    def of_doubled_frames(self) -> Taps:
        """The same over frames that are then each shown twice: makes both results of a frame at once.

        Two taps that meet the same frame are one. Outputs are those of even frames, then those of odd ones.
        """
        reach = self.weight.shape[2] // 2
        farthest = (reach + 1) // 2
        both = self.weight.new_zeros(2, *self.weight.shape[:2], 2 * farthest + 1)
        for odd in (0, 1):
            for place, tap in enumerate(self.weight.unbind(2)):
                both[odd, ..., farthest + (odd + place - reach) // 2] += tap
        return Taps(both.flatten(0, 1), self.bias.repeat(2))
