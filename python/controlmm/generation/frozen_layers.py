"""Convolutions with frozen weights as matrix products: what editing spends its time in.

An editing step needs no gradient of the weights, so a convolution is a product with one matrix on the way
forward and with another on the way back, and both are prepared before the first step.
"""

from __future__ import annotations

import math
import threading
from functools import lru_cache
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from controlmm.generation.clip_groups import Lengths
from controlmm.generation.convolution_taps import Taps
from controlmm.generation.frozen_matrix import FrozenMatrix
from controlmm.generation.winograd_layer import WinogradLayer
from controlmm.ops import available_isas


class FrozenConv:
    """A convolution of width 1 or 3 over time that keeps the number of frames; (B, T, C) tensors.

    Args:
        weight: The filters.
        bias: Of each output.
        dilation: Frames between a filter's taps.
        dtype: Of the arithmetic.
        is_long: Whether clips have many frames here, so that a way with fewer and smaller products pays.
    """

    def __init__(
        self,
        weight: Float[Tensor, "out in k"],
        bias: Float[Tensor, "out"],
        dilation: int,
        dtype: torch.dtype,
        *,
        is_long: bool = False,
    ) -> None:
        weight, turned = weight.detach(), weight.detach().flip(-1).transpose(0, 1)
        self._forward: _Layer
        self._backward: _Layer
        if is_long and weight.shape[-1] == 3 and dtype == torch.float32 and available_isas():
            self._forward = WinogradLayer(weight, bias, dilation)
            self._backward = WinogradLayer(turned, None, dilation)
        else:
            self._forward = _DirectLayer(weight, bias, dilation, dtype)
            self._backward = _DirectLayer(turned, None, dilation, dtype)

    @classmethod
    def of(cls, conv: nn.Conv1d, dtype: torch.dtype, *, is_long: bool = False) -> FrozenConv:
        """A frozen copy of ``conv``."""
        assert conv.bias is not None  # the decoder's convolutions all have one
        return cls(conv.weight, conv.bias.detach(), conv.dilation[0], dtype, is_long=is_long)

    @classmethod
    def of_taps(cls, taps: Taps, dtype: torch.dtype, *, is_long: bool = False) -> FrozenConv:
        """One with these weights, frame by frame."""
        return cls(taps.weight, taps.bias, 1, dtype, is_long=is_long)

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
        return self._forward(x, lengths, is_rectified=is_rectified, is_tangent=is_tangent)

    def backward(self, gradient: Float[Tensor, "B T D"], lengths: Lengths = ()) -> Float[Tensor, "B T C"]:
        """The gradient in the input, given that in the output."""
        return self._backward(gradient, lengths, is_rectified=False, is_tangent=True)


class _Layer(Protocol):
    def __call__(self, x: Tensor, lengths: Lengths, *, is_rectified: bool, is_tangent: bool) -> Tensor: ...


class _DirectLayer:
    """One product with every frame beside its neighbours."""

    def __init__(self, weight: Tensor, bias: Tensor | None, dilation: int, dtype: torch.dtype) -> None:
        self._dilation, self._taps = dilation, weight.shape[-1]
        self._matrix = FrozenMatrix(weight.permute(0, 2, 1).flatten(1), bias, dtype)

    def __call__(self, x: Tensor, lengths: Lengths, *, is_rectified: bool, is_tangent: bool) -> Tensor:
        rows = (x if self._taps == 1 else neighbours(x, self._dilation, lengths)).flatten(0, 1)
        product = self._matrix(rows, activation="relu" if is_rectified else "none", is_tangent=is_tangent)
        return product.view(*x.shape[:2], -1)


def neighbours(x: Float[Tensor, "B T C"], distance: int, lengths: Lengths = ()) -> Float[Tensor, "B T 3C"]:
    """Every frame between those ``distance`` before and after it, zeros beyond the ends.

    The thread's next call writes over the result. For ``lengths`` see :class:`FrozenConv`.
    """
    batch, frames, channels = x.shape
    shown, beyond = _shown(lengths or (frames,) * batch, distance)
    rows = _SCRATCH.empty((len(shown), channels), x.dtype)
    torch.index_select(x.flatten(0, 1), 0, shown, out=rows)
    rows.index_fill_(0, beyond, 0)
    return rows.view(batch, frames, 3 * channels)


@lru_cache(maxsize=256)
def _shown(lengths: Lengths, distance: int) -> tuple[Int[Tensor, "3N"], Int[Tensor, "M"]]:
    """What is before, at and after each frame of clips end to end, and which of it is beyond the clip."""
    counts = torch.tensor(lengths)
    first = (counts.cumsum(0) - counts).repeat_interleave(counts)[:, None]
    last = first + counts.repeat_interleave(counts)[:, None] - 1
    wanted = torch.arange(len(first))[:, None] + torch.tensor([-distance, 0, distance])
    shown = wanted.clamp(first, last)
    return shown.flatten(), (shown != wanted).flatten().nonzero()[:, 0]


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
