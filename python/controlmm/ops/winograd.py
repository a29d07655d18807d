"""Convolutions over time of width 3 by Winograd's minimal filtering F(4, 3): half the products.

Four outputs of a filter of three taps take six products instead of twelve. Source: Winograd, *Arithmetic
Complexity of Computations* (1980); Lavin and Gray, *Fast Algorithms for Convolutional Neural Networks* (CVPR
2016). In float32 an output errs by 7e-7 of a typical one (by direct sums 2e-7).

A convolution of clips that lie end to end is

    tiles = WinogradTiles.of(lengths, distance)
    products = winograd_parts(x, tiles) @ winograd_weights(weight).mT
    y = winograd_frames(products, tiles, bias)
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.ops.backend import Backend, core, runs_native
from controlmm.ops.winograd_reference import winograd_frames_reference, winograd_parts_reference
from controlmm.ops.winograd_tiles import PRODUCTS, WinogradTiles

# Of the weights, for filtering at the points 0, 1, -1, 2, -2 and infinity.
_OF_WEIGHTS = (
    (1 / 4, 0, 0),
    (-1 / 6, -1 / 6, -1 / 6),
    (-1 / 6, 1 / 6, -1 / 6),
    (1 / 24, 1 / 12, 1 / 6),
    (1 / 24, -1 / 12, 1 / 6),
    (0, 0, 1),
)


def winograd_weights(weight: Float[Tensor, "D C 3"]) -> Float[Tensor, "6 D C"]:
    """The matrices of the six products, made in float64 and given in the weights' type.

    Raises:
        ValueError: If the filters are not three taps wide, or not floating-point.
    """
    if weight.ndim != 3 or weight.shape[2] != 3 or not weight.is_floating_point():
        came = f"{weight.dtype} of {tuple(weight.shape)}"
        raise ValueError(f"`weight` must be floating-point of shape (D, C, 3), got {came}.")
    factors = torch.tensor(_OF_WEIGHTS, dtype=torch.float64, device=weight.device)
    return torch.einsum("pk,dck->pdc", factors, weight.double()).to(weight.dtype)


def winograd_parts(
    x: Float[Tensor, "T C"], tiles: WinogradTiles, *, backend: Backend | None = None
) -> Float[Tensor, "6 M C"]:
    """What the six products take, without gradients: sums of a tile's frames.

    Args:
        x: Frames of clips that lie end to end.
        tiles: Which frames go together.
        backend: "native", "reference" or "auto"; ``None`` asks the context and the environment.

    Raises:
        ValueError: If ``x`` does not have the tiles' frames, or "native" was asked for and cannot run.
    """
    if x.ndim != 2 or len(x) != tiles.frames or not x.is_floating_point():
        came = f"{x.dtype} of {tuple(x.shape)}"
        raise ValueError(f"`x` must be floating-point of shape ({tiles.frames}, C), got {came}.")
    x = x.detach()
    if not runs_native(backend, x):
        return winograd_parts_reference(x, tiles)
    parts = x.new_empty(PRODUCTS, len(tiles), x.shape[1])
    core().winograd_parts(x.contiguous(), tiles.taken.contiguous(), parts)
    return parts


def winograd_frames(
    products: Float[Tensor, "6 M D"],
    tiles: WinogradTiles,
    bias: Float[Tensor, "D"] | None = None,
    *,
    is_rectified: bool = False,
    backend: Backend | None = None,
) -> Float[Tensor, "T D"]:
    """The convolution's frames, without gradients: sums of six products each, and the bias.

    Args:
        products: Of the six matrices with the six parts.
        tiles: As for :func:`winograd_parts`.
        bias: Added to every frame.
        is_rectified: Whether what is negative becomes zero.
        backend: As in :func:`winograd_parts`.

    Raises:
        ValueError: If shapes or types do not fit, or "native" was asked for and cannot run.
    """
    if products.ndim != 3 or products.shape[:2] != (PRODUCTS, len(tiles)) or not products.is_floating_point():
        came = f"{products.dtype} of {tuple(products.shape)}"
        raise ValueError(
            f"`products` must be floating-point of shape ({PRODUCTS}, {len(tiles)}, D), got {came}."
        )
    if bias is not None and (bias.shape != products.shape[2:] or bias.dtype != products.dtype):
        came = f"{bias.dtype} of {tuple(bias.shape)}"
        raise ValueError(f"`bias` must be {products.dtype} of shape {tuple(products.shape[2:])}, got {came}.")
    products = products.detach()
    if not runs_native(backend, products):
        return winograd_frames_reference(products, tiles, bias, is_rectified=is_rectified)
    y = products.new_empty(tiles.frames, products.shape[2])
    bias = products.new_zeros(0) if bias is None else bias.detach().contiguous()
    core().winograd_frames(products.contiguous(), tiles.made.contiguous(), bias, is_rectified, y)
    return y
