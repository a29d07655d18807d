"""Plain-torch twins of the kernels around the products of Winograd's minimal filtering F(4, 3)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.ops.winograd_tiles import WinogradTiles

# For filtering at the points 0, 1, -1, 2, -2 and infinity.
_OF_INPUTS = (
    (4, 0, -5, 0, 1, 0),
    (0, -4, -4, 1, 1, 0),
    (0, 4, -4, -1, 1, 0),
    (0, -2, -1, 2, 1, 0),
    (0, 2, -1, -2, 1, 0),
    (0, 4, 0, -5, 0, 1),
)
_OF_PRODUCTS = (
    (1, 1, 1, 1, 1, 0),
    (0, 1, -1, 2, -2, 0),
    (0, 1, 1, 4, 4, 0),
    (0, 1, -1, 8, -8, 1),
)


def winograd_parts_reference(x: Float[Tensor, "T C"], tiles: WinogradTiles) -> Float[Tensor, "6 M C"]:
    """See :func:`controlmm.ops.winograd_parts`."""
    frames = torch.cat([x, x.new_zeros(1, x.shape[1])])[tiles.taken]  # -1 is the last row: zeros
    return torch.einsum("pk,mkc->pmc", x.new_tensor(_OF_INPUTS), frames)


def winograd_frames_reference(
    products: Float[Tensor, "6 M D"],
    tiles: WinogradTiles,
    bias: Float[Tensor, "D"] | None,
    *,
    is_rectified: bool,
) -> Float[Tensor, "T D"]:
    """See :func:`controlmm.ops.winograd_frames`."""
    made = torch.einsum("op,pmd->mod", products.new_tensor(_OF_PRODUCTS), products)
    is_wanted = tiles.made >= 0
    y = products.new_empty(tiles.frames, products.shape[2])
    y[tiles.made[is_wanted]] = made[is_wanted]
    if bias is not None:
        y = y + bias
    return y.relu() if is_rectified else y
