"""A frozen convolution of width 3 with half the products, for many frames: Winograd's minimal filtering."""

from __future__ import annotations

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.generation.clip_groups import Lengths
from controlmm.generation.frozen_matrix import FrozenMatrices
from controlmm.ops import WinogradTiles, winograd_frames, winograd_parts, winograd_weights


class WinogradLayer:
    """One direction of a :class:`FrozenConv`, see :mod:`controlmm.ops.winograd`; float32."""

    def __init__(
        self, weight: Float[Tensor, "out in 3"], bias: Float[Tensor, "out"] | None, distance: int
    ) -> None:
        self._distance, self._bias = distance, None if bias is None else bias.detach().float()
        self._matrices = FrozenMatrices(winograd_weights(weight.detach().double()))

    def __call__(
        self, x: Float[Tensor, "B T C"], lengths: Lengths, *, is_rectified: bool, is_tangent: bool
    ) -> Float[Tensor, "B T D"]:
        """The convolution; of a tangent: without the bias."""
        tiles = _tiles(lengths or (x.shape[1],) * len(x), self._distance)
        products = self._matrices(winograd_parts(x.flatten(0, 1), tiles))
        bias = None if is_tangent else self._bias
        return winograd_frames(products, tiles, bias, is_rectified=is_rectified).view(*x.shape[:2], -1)


@lru_cache(maxsize=256)
def _tiles(lengths: Lengths, distance: int) -> WinogradTiles:
    with torch.inference_mode(False):  # what is kept must be of use outside that mode, too
        return WinogradTiles.of(lengths, distance)
