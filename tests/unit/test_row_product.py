"""Products of rows: right, and the same to the bit in any company, also where there are few of anything."""

from __future__ import annotations

import torch

from controlmm.nn.row_product import row_product, row_products

ROUNDING = 1e-5  # of float32 sums of 512 products


def test_a_row_is_the_same_in_any_company():
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(1, 200, 512, generator=generator).softmax(-1)
    for matrix in (torch.randn(512, 48, generator=generator), torch.randn(48, 512, generator=generator).T):
        together = row_product(rows, matrix)
        torch.testing.assert_close(together, rows @ matrix, rtol=ROUNDING, atol=ROUNDING)
        for count in (*range(1, 30), 49, 98):
            assert torch.equal(row_product(rows[:, :count], matrix), together[:, :count])
            assert torch.equal(row_product(rows[:, -count:], matrix), together[:, -count:])


def test_a_column_is_the_same_beside_any_others():
    generator = torch.Generator().manual_seed(2)
    rows, matrix, bias = (torch.randn(*size, generator=generator) for size in ((40, 6, 96), (96, 70), (70,)))
    together = row_product(rows, matrix, bias)
    torch.testing.assert_close(together, rows @ matrix + bias, rtol=ROUNDING, atol=10 * ROUNDING)
    for first, end in ((0, 1), (3, 10), (30, 41), (5, 21), (1, 70)):
        part = row_product(rows[:7], matrix[:, first:end].contiguous(), bias[first:end])
        assert torch.equal(part, together[:7, :, first:end])


def test_how_rows_lie_in_memory_does_not_matter():
    rows = torch.randn(200, 64, generator=torch.Generator().manual_seed(3))
    matrix = torch.randn(64, 20, generator=torch.Generator().manual_seed(4))
    assert torch.equal(row_product(rows.T.contiguous().T, matrix), row_product(rows, matrix))


def test_several_products_at_once_are_what_each_is_alone():
    generator = torch.Generator().manual_seed(5)
    for rows, width in ((40, 30), (3, 48), (27, 5)):
        x = torch.randn(6, rows, 64, generator=generator)
        matrices = torch.randn(6, 64, width, generator=generator)
        for part, matrix, product in zip(x, matrices, row_products(x, matrices), strict=True):
            assert torch.equal(product, row_product(part, matrix))


def test_rows_have_gradients():
    rows = torch.randn(2, 3, 5, generator=torch.Generator().manual_seed(1)).requires_grad_()
    matrix = torch.eye(5)[:, :4]
    (gradient,) = torch.autograd.grad(row_product(rows, matrix).sum(), rows)
    assert torch.equal(gradient, matrix.sum(1).expand_as(rows))
