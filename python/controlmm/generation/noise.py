"""Random numbers of a batch, drawn for each clip on its own."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

_SPREAD = 0x9E3779B97F4A7C15  # odd 64-bit constant: neighbouring seeds give unrelated streams


def clip_seeds(seed: int, count: int) -> list[int]:
    """A seed for each of ``count`` samples; sample ``i`` of a seed is the same however many are asked for."""
    return [(int(seed) * _SPREAD + index * 0xBF58476D1CE4E5B9) % 2**63 for index in range(count)]


class ClipNoise:
    """One random stream a clip, so that its motion does not depend on the clips beside it or on padding."""

    def __init__(self, seeds: Sequence[int]) -> None:
        self._generators = [torch.Generator().manual_seed(seed) for seed in seeds]

    def gumbel(self, lengths: Sequence[int], *, padded: int, width: int) -> Float[Tensor, "B L K"]:
        """Standard Gumbel noise for the first ``lengths[b]`` rows of every clip, zero in padding."""
        noise = torch.zeros(len(self._generators), padded, width)
        for row, length, generator in zip(noise, lengths, self._generators, strict=True):
            row[:length].exponential_(generator=generator).clamp_(min=1e-30).log_().neg_()
        return noise
