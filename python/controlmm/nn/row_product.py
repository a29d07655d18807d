"""A product with a matrix whose rows do not depend on how many there are."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

_FEWEST = 16  # with AVX2, MKL adds up the terms of a row in another order where there are fewer than twelve


def row_product(x: Float[Tensor, "B L K"], matrix: Float[Tensor, "K C"]) -> Float[Tensor, "B L C"]:
    """``x @ matrix``, the same to the last bit for a row in any company."""
    rows = x.flatten(0, 1)
    product: Tensor = pad(rows, (0, 0, 0, max(0, _FEWEST - len(rows)))) @ matrix
    return product[: len(rows)].view(*x.shape[:2], -1)
