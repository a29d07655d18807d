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
    rows = x.flatten(0, -2).contiguous()  # a transposed factor is added up in another order
    count, width = len(rows), matrix.shape[1]
    if count < _FEWEST:
        rows = pad(rows, (0, 0, 0, _FEWEST - count))
    if width < _FEWEST:
        matrix = pad(matrix, (0, _FEWEST - width))
        bias = None if bias is None else pad(bias, (0, _FEWEST - width))
    product: Tensor = rows @ matrix if bias is None else torch.addmm(bias, rows, matrix)
    return product[:count, :width].contiguous().view(*x.shape[:-1], width)
