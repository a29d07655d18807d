"""A product with a matrix whose elements do not depend on how many others there are."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

_FEWEST = 16  # with AVX2, MKL adds up an element in other orders where rows or columns are fewer than twelve


def row_product(
    x: Float[Tensor, "*B K"], matrix: Float[Tensor, "K C"], bias: Float[Tensor, "C"] | None = None
) -> Float[Tensor, "*B C"]:
    """``x @ matrix + bias``; a row is the same to the bit in any company, and so is a column."""
    rows = x if x.ndim == 2 else x.flatten(0, -2)
    count, width = len(rows), matrix.shape[1]
    rows, matrix = _long_enough(rows), _wide_enough(matrix)
    bias = None if bias is None else _wide_enough(bias)
    product: Tensor = rows @ matrix if bias is None else torch.addmm(bias, rows, matrix)
    if product.shape != (count, width):
        product = product[:count, :width].contiguous()
    return product if x.ndim == 2 else product.view(*x.shape[:-1], width)


def row_products(x: Float[Tensor, "P M K"], matrices: Float[Tensor, "P K C"]) -> Float[Tensor, "P M C"]:
    """``x @ matrices``, all in one call; to the bit what :func:`row_product` makes of each."""
    count, width = x.shape[1], matrices.shape[2]
    product: Tensor = torch.bmm(_long_enough(x), _wide_enough(matrices))
    return product if product.shape[1:] == (count, width) else product[:, :count, :width].contiguous()


def _long_enough(x: Float[Tensor, "*P M K"]) -> Float[Tensor, "*P N K"]:
    missing = _FEWEST - x.shape[-2]
    # A transposed factor would be added up in another order.
    return pad(x, (0, 0, 0, missing)) if missing > 0 else x.contiguous()


def _wide_enough(matrix: Float[Tensor, "*P C"]) -> Float[Tensor, "*P D"]:
    missing = _FEWEST - matrix.shape[-1]
    return pad(matrix, (0, missing)) if missing > 0 else matrix
