"""Products with frozen weights, brought once into the order that the processor likes.

A row gets the same numbers, bit by bit, in any batch and with any number of threads: oneDNN's packed products
promise nothing of the kind, but tests hold them to it, and MKL's are tried for each shape of matrix.
"""

from __future__ import annotations

import os
from functools import cache
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from controlmm.generation.one_thread import one_thread
from controlmm.nn.row_product import row_product, row_products

Activation = Literal["none", "relu", "gelu"]

_TYPICAL_ROWS = 196  # the frames of one clip: what packing prepares for
# Wider products in bfloat16 are sums of narrower ones: oneDNN would sum a row in an order that depends on how
# many rows there are.
_WIDEST_BFLOAT16 = 256
_TRIED_ROWS = (1, 16, 17, 19, 49, 98, 197, 421)  # the last are all rows that are tried


def has_fast_bfloat16() -> bool:
    """Whether this processor multiplies bfloat16 in tiles (AMX), and ``CONTROLMM_BFLOAT16`` is not 0."""
    return (
        os.environ.get("CONTROLMM_BFLOAT16") != "0"
        and bool(torch.cpu._is_amx_tile_supported())
        and _packed(torch.zeros(16, 16, dtype=torch.bfloat16)) is not None
    )


class FrozenMatrix:
    """``x -> x W^T + b`` with a packed ``W``."""

    def __init__(
        self, weight: Float[Tensor, "out in"], bias: Float[Tensor, "out"] | None, dtype: torch.dtype
    ) -> None:
        weight = weight.detach().to(dtype)
        self._bias = None if bias is None else bias.detach().to(dtype)
        count = -(-weight.shape[1] // _WIDEST_BFLOAT16) if dtype == torch.bfloat16 else 1
        self._widths = [part.shape[1] for part in weight.tensor_split(count, dim=1)]
        self._parts = [_Columns(part.contiguous()) for part in weight.split(self._widths, dim=1)]

    def __call__(
        self, x: Float[Tensor, "N in"], *, activation: Activation = "none", is_tangent: bool = False
    ) -> Float[Tensor, "N out"]:
        """The product after an activation; of a tangent: without the bias."""
        bias = None if is_tangent else self._bias
        first, *others = self._parts
        if not others:
            return first.product(x, bias, activation)
        inputs = x.split(self._widths, dim=1)
        total = first.product(inputs[0], bias).float()
        for part, columns in zip(inputs[1:], others, strict=True):
            total += columns.product(part, None)
        return _activated(total, activation).to(x.dtype)


class FrozenMatrices:
    """``x -> x W^T`` with several ``W`` of one shape, each for its part of ``x``; float32."""

    def __init__(self, weights: Float[Tensor, "P out in"]) -> None:
        weights = weights.detach().float()
        self._transposed: Tensor | None = None
        self._each: list[FrozenMatrix] = []
        if plain_products_are_best(*weights.shape[1:]):
            self._transposed = weights.mT.contiguous()
        else:
            self._each = [FrozenMatrix(weight, None, torch.float32) for weight in weights]

    def __call__(self, x: Float[Tensor, "P N in"]) -> Float[Tensor, "P N out"]:
        """The products."""
        if self._transposed is not None:
            return row_products(x, self._transposed)
        return torch.stack([matrix(part) for matrix, part in zip(self._each, x, strict=True)])


class _Columns:
    """Some columns of a matrix, packed where the processor can and is no quicker without."""

    def __init__(self, weight: Float[Tensor, "out in"]) -> None:
        is_plain = weight.dtype == torch.float32 and plain_products_are_best(*weight.shape)
        self._packed = None if is_plain else _packed(weight)
        self._transposed = weight.t().contiguous() if self._packed is None else None

    def product(self, x: Tensor, bias: Tensor | None, activation: Activation = "none") -> Tensor:
        if self._transposed is not None:
            return _activated(row_product(x, self._transposed, bias), activation)
        fused = "none" if activation == "gelu" else activation  # torch's own takes a third of oneDNN's time
        result: Tensor = torch.ops.mkldnn._linear_pointwise(x, self._packed, bias, fused, [], "")
        return nn.functional.gelu(result) if activation == "gelu" else result


def _activated(x: Tensor, activation: Activation) -> Tensor:
    if activation == "relu":
        return x.clamp_min_(0)
    return nn.functional.gelu(x) if activation == "gelu" else x


@cache
@one_thread()
@torch.inference_mode()
def plain_products_are_best(outputs: int, inputs: int) -> bool:
    """Whether MKL's float32 products with a matrix of this shape are to be preferred to oneDNN's.

    They are the quicker ones on processors with AVX2 and nothing wider (of one core of an EPYC 91 GFLOP/s for
    79, with 200 rows or 3,000). An element must not depend on what is beside it, which is tried here.
    """
    if torch.backends.cpu.get_cpu_capability() != "AVX2" or not torch.backends.mkl.is_available():
        return False
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(_TRIED_ROWS[-1], inputs, generator=generator)
    matrix = torch.randn(inputs, outputs, generator=generator)
    product, half = row_product(rows, matrix), matrix[:, : -(-outputs // 2)].contiguous()
    return all(
        torch.equal(row_product(rows[-n:], part), product[-n:, : part.shape[1]])
        for n in _TRIED_ROWS
        for part in (matrix, half)
    )


def _packed(weight: Tensor) -> Tensor | None:
    """``weight`` in oneDNN's order; ``None`` where this torch or processor cannot."""
    if weight.dtype == torch.float64 or not torch.backends.mkldnn.is_available():
        return None
    try:
        packed: Tensor = torch.ops.mkldnn._reorder_linear_weight(weight, _TYPICAL_ROWS)
        torch.ops.mkldnn._linear_pointwise(weight.new_zeros(1, weight.shape[1]), packed, None, "none", [], "")
    except (AttributeError, RuntimeError):  # the operators are private: other versions may lack them
        return None
    return packed
