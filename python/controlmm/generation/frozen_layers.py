"""Convolutions with frozen weights as matrix products: what editing spends its time in.

An editing step needs no gradient of the weights, so a convolution is a product with one matrix on the way
forward and with another on the way back, and both are prepared before the first step.
"""

from __future__ import annotations

import math
import threading
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from controlmm.generation.convolution_taps import Taps
from controlmm.generation.frozen_matrix import Activation, FrozenMatrix

Lengths = tuple[int, ...]  # of clips that lie end to end


class FrozenConv:
    """A convolution of width 1 or 3 over time that keeps the number of frames; (B, T, C) tensors."""

    def __init__(
        self, weight: Float[Tensor, "out in k"], bias: Float[Tensor, "out"], dilation: int, dtype: torch.dtype
    ) -> None:
        weight = weight.detach()
        self._dilation, self._taps = dilation, weight.shape[-1]
        self._forward = FrozenMatrix(weight.permute(0, 2, 1).flatten(1), bias, dtype)
        self._backward = FrozenMatrix(weight.flip(-1).permute(1, 2, 0).flatten(1), None, dtype)

    @classmethod
    def of(cls, conv: nn.Conv1d, dtype: torch.dtype) -> FrozenConv:
        """A frozen copy of ``conv``."""
        assert conv.bias is not None  # the decoder's convolutions all have one
        return cls(conv.weight, conv.bias.detach(), conv.dilation[0], dtype)

    @classmethod
    def of_taps(cls, taps: Taps, dtype: torch.dtype) -> FrozenConv:
        """One with these weights, frame by frame."""
        return cls(taps.weight, taps.bias, 1, dtype)

    def forward(
        self,
        x: Float[Tensor, "B T C"],
        lengths: Lengths = (),
        *,
        is_rectified: bool = False,
        is_tangent: bool = False,
    ) -> Float[Tensor, "B T D"]:
        """The convolution, rectified if asked for; of a tangent: without the bias.

        Of one row, ``lengths`` are the frames of the clips that lie in it end to end.
        """
        activation: Activation = "relu" if is_rectified else "none"
        product = self._forward(self._rows(x, lengths), activation=activation, is_tangent=is_tangent)
        return product.view(*x.shape[:2], -1)

    def backward(self, gradient: Float[Tensor, "B T D"], lengths: Lengths = ()) -> Float[Tensor, "B T C"]:
        """The gradient in the input, given that in the output."""
        return self._backward(self._rows(gradient, lengths)).view(*gradient.shape[:2], -1)

    def _rows(self, x: Float[Tensor, "B T C"], lengths: Lengths) -> Float[Tensor, "N taps"]:
        return x.flatten(0, 1) if self._taps == 1 else neighbours(x, self._dilation, lengths).flatten(0, 1)


def neighbours(x: Float[Tensor, "B T C"], distance: int, lengths: Lengths = ()) -> Float[Tensor, "B T 3C"]:
    """Every frame between those ``distance`` before and after it, zeros beyond the ends.

    The thread's next call writes over the result. For ``lengths`` see :class:`FrozenConv`.
    """
    batch, frames, channels = x.shape
    rows = _SCRATCH.empty((batch, frames, 3 * channels), x.dtype)
    reach = min(distance, frames)
    rows[:, :reach, :channels] = 0
    rows[:, reach:, :channels] = x[:, : frames - reach]
    rows[..., channels : 2 * channels] = x
    rows[:, : frames - reach, 2 * channels :] = x[:, reach:]
    rows[:, frames - reach :, 2 * channels :] = 0
    if len(lengths) > 1:
        first, last = _ends(lengths, distance)
        rows[0, :, :channels].index_fill_(0, first, 0)
        rows[0, :, 2 * channels :].index_fill_(0, last, 0)
    return rows


@lru_cache(maxsize=256)
def _ends(lengths: Lengths, distance: int) -> tuple[Int[Tensor, "N"], Int[Tensor, "M"]]:
    """The first and the last ``distance`` frames of clips that lie end to end."""
    first, last, start = [], [], 0
    for length in lengths:
        end, reach = start + length, min(distance, length)
        first.append(torch.arange(start, start + reach))
        last.append(torch.arange(end - reach, end))
        start = end
    return torch.cat(first), torch.cat(last)


class _Scratch(threading.local):
    """Memory that stays: of eight clips, fresh pages cost more than what is written into them."""

    def __init__(self) -> None:
        self._memory: dict[torch.dtype, Tensor] = {}

    def empty(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """Not initialised, and shared with all that were asked for before."""
        size = math.prod(shape)
        if dtype not in self._memory or self._memory[dtype].numel() < size:
            with torch.inference_mode(False):  # else it could not be written outside that mode
                self._memory[dtype] = torch.empty(size, dtype=dtype)
        return self._memory[dtype][:size].view(shape)


_SCRATCH = _Scratch()
