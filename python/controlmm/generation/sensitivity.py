"""How strongly and how jointly the decoder's channels answer to the latents, for latents on average.

Gauss-Newton needs ``G = D D^T``, where D is the decoder's Jacobian. One D costs a backward pass for every
channel of every frame. But the decoder is a convolution: up to which rectifiers are on, its rows are copies
of each other, shifted by tokens. So the rows of one token are taken from a few random sequences of codes; G
is the product of the mean rows, plus what single rows scatter about the mean. It is made once for a decoder
and a choice of channels, and serves as metric of every clip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.generation.code_spread import CodeSpread
from controlmm.generation.frozen_decoder import FrozenDecoder
from controlmm.generation.one_thread import one_thread

_BITS = 20  # of a row's largest entry: products have 40, and float64 holds sums of 2^13 of them exactly
WINDOW = 25  # tokens of a sequence; of a channel's answer, less than 2 % comes from farther away than 12


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Answers of ``D`` channels in the ``S`` frames of one token.

    Attributes:
        mean: (D, S, W, C), the mean rows of the Jacobian: change of a channel for a unit step in each
            direction of the W tokens around.
        scatter: (D, S), the mean squared length of what single rows have beyond the mean.
    """

    mean: Float[Tensor, "D S W C"]
    scatter: Float[Tensor, "D S"]

    @classmethod
    def joined(cls, channels: Sequence[Sensitivity]) -> Sensitivity:
        """Of all channels of several."""
        return cls(
            torch.cat([channel.mean for channel in channels]),
            torch.cat([channel.scatter for channel in channels]),
        )

    def gram(self, tokens: int) -> Float[Tensor, "D T D T"]:
        """``G`` for a clip of ``tokens`` tokens."""
        channels, step, window = self.mean.shape[:3]
        rows = _in_whole_numbers(self.mean.flatten(0, 1).double())  # (N, W, C) with N = D S
        lags = torch.zeros(2 * window, len(rows), len(rows), dtype=torch.float64)  # the last: out of sight
        for lag in range(window):  # token s sees at w what token s + lag sees at w - lag
            overlap = rows[:, lag:].flatten(1) @ rows[:, : window - lag].flatten(1).T
            lags[window - 1 + lag], lags[window - 1 - lag] = overlap, overlap.T
        token = torch.arange(tokens)
        distance = token[None, :] - token[:, None]  # (L, L)
        which = (distance + window - 1).where(distance.abs() < window, 2 * window - 1)
        blocks = lags.reshape(-1, channels, step, channels, step).permute(1, 2, 3, 0, 4).float().contiguous()
        split = torch.empty(channels, tokens, step, channels, tokens, step)
        for row in range(tokens):  # this matrix may take 50 MB: it is written once
            split[:, row] = blocks[:, :, :, which[row]]
        frames = tokens * step
        gram = split.view(channels, frames, channels, frames)
        own = self.scatter.repeat(1, tokens).flatten()
        gram.view(channels * frames, channels * frames).diagonal().add_(own)
        return gram


def _in_whole_numbers(rows: Float[Tensor, "N W C"]) -> Float[Tensor, "N W C"]:
    """Rows as multiples of a power of two: sums of their products are exact, and in any order the same."""
    exponent = torch.frexp(rows.flatten(1).abs().amax(1)).exponent
    unit = torch.ldexp(torch.ones_like(exponent, dtype=rows.dtype), exponent - _BITS)[:, None, None]
    return (rows / unit).round() * unit


@one_thread()
def measure_sensitivity(
    decoder: FrozenDecoder,
    latents: Float[Tensor, "S W C"],
    channels: Sequence[int],
    *,
    downsample: int,
    spread: CodeSpread,
) -> Sensitivity:
    """Measure a decoder on some sequences.

    Args:
        decoder: What is measured.
        latents: Sequences of W tokens like those that will be edited.
        channels: Which channels of the decoder's output.
        downsample: Frames for each token.
        spread: The unit of the latents' steps.
    """
    sequences, window, width = latents.shape
    _, tape = decoder.forward(latents, channels, is_looked_at_again=True)
    count, middle = len(channels) * downsample, window // 2 * downsample
    seeds = torch.zeros(count, window * downsample, len(channels))
    for row in range(count):
        seeds[row, middle + row % downsample, row // downsample] = 1
    which = torch.arange(sequences).repeat_interleave(count)
    pulled = spread.gradient(decoder.pull(tape.select(which), seeds.repeat(sequences, 1, 1)))
    total, power = torch.zeros(count, window, width), torch.zeros(count)
    for rows in pulled.unflatten(0, (sequences, count)):
        total += rows
        power += rows.square().sum((1, 2))
    mean, shape = total / sequences, (len(channels), downsample)
    scatter = (power / sequences - mean.square().sum((1, 2))).clamp(min=0)
    return Sensitivity(mean.unflatten(0, shape), scatter.unflatten(0, shape))
