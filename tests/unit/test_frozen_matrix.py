"""Frozen products: right, alike in any company, and whose they are."""

from __future__ import annotations

import pytest
import torch

from controlmm.generation import frozen_matrix
from controlmm.generation.frozen_matrix import FrozenMatrix, plain_products_are_best

ROUNDING = 2e-5  # of float32 sums of 200 products
SHAPES = [(1, 64), (7, 200), (16, 64), (48, 200)]  # outputs, inputs


@pytest.fixture(params=["oneDNN", "MKL"])
def products(request, monkeypatch):
    is_plain = request.param == "MKL"
    if is_plain and not plain_products_are_best(48, 200):
        pytest.skip("MKL's products are for processors with AVX2 and nothing wider")
    monkeypatch.setattr(frozen_matrix, "plain_products_are_best", lambda outputs, inputs: is_plain)


def values(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("outputs", "inputs"), SHAPES)
def test_products_are_right_and_alike_in_any_company(products, outputs, inputs):
    weight, bias, rows = values(outputs, inputs), values(outputs, seed=1), values(300, inputs, seed=2)
    matrix = FrozenMatrix(weight, bias, torch.float32)
    together = matrix(rows, activation="relu")
    expected = torch.nn.functional.linear(rows.double(), weight.double(), bias.double()).relu()
    torch.testing.assert_close(together.double(), expected, rtol=ROUNDING, atol=ROUNDING)
    for count in (*range(1, 20), 49, 98, 197):
        assert torch.equal(matrix(rows[-count:], activation="relu"), together[-count:])
    tangent = matrix(rows, is_tangent=True)
    torch.testing.assert_close(tangent, rows @ weight.T, rtol=ROUNDING, atol=10 * ROUNDING)


def asked_anew(outputs: int, inputs: int) -> bool:
    plain_products_are_best.cache_clear()
    try:
        return plain_products_are_best(outputs, inputs)
    finally:
        plain_products_are_best.cache_clear()


def test_processors_with_wider_registers_keep_to_packed_products(monkeypatch):
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    assert not asked_anew(48, 200)


def test_products_that_depend_on_their_company_are_not_taken(monkeypatch):
    """What another MKL might do: rows are a little different when they are many."""
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX2")
    monkeypatch.setattr(torch.backends.mkl, "is_available", lambda: True)
    honest = frozen_matrix.row_product
    monkeypatch.setattr(
        frozen_matrix,
        "row_product",
        lambda x, matrix: honest(x, matrix) * (1 + 1e-6 * (len(x) > 100)),
    )
    assert not asked_anew(48, 200)
