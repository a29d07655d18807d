"""Dropout with cheap masks against what dropout is."""

from __future__ import annotations

import math

import pytest
import torch

from controlmm.nn.dropout import Dropout

SIGMAS = 4.5  # a right share is missed by this many standard errors once in 150 000 tests


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("probability", [0.1, 0.5, 0.9])
def test_a_share_becomes_zero_and_the_rest_is_scaled(probability, dtype):
    torch.manual_seed(0)
    x = torch.ones(321, 77, 5, dtype=dtype)
    dropped = Dropout(probability)(x)
    assert dropped.dtype == dtype
    share = (dropped == 0).double().mean().item()
    error = SIGMAS * math.sqrt(probability * (1 - probability) / x.numel())
    assert share == pytest.approx(probability, abs=error + 2**-16)
    kept = dropped[dropped != 0].double().unique()
    assert len(kept) == 1
    assert kept.item() == pytest.approx(1 / (1 - probability), rel=1e-2 if dtype is torch.bfloat16 else 1e-3)


def test_neighbours_are_dropped_independently():
    """Four elements share a 64-bit number: pairs at distances 1 to 5 must be independent all the same."""
    torch.manual_seed(1)
    zero = Dropout(0.3)(torch.ones(200_000)) == 0
    for distance in range(1, 6):
        both = (zero[:-distance] & zero[distance:]).double().mean().item()
        assert both == pytest.approx(0.09, abs=SIGMAS * math.sqrt(0.09 * 0.91 / 2e5) * 1.5)


def test_the_gradient_passes_where_the_input_did():
    torch.manual_seed(2)
    x = torch.randn(50, 9, requires_grad=True)
    result = Dropout(0.25)(x)
    result.sum().backward()
    torch.testing.assert_close(x.grad, (result != 0) * (1 / 0.75), rtol=1e-4, atol=0)


def test_evaluation_and_probability_zero_change_nothing():
    x = torch.randn(5, 3)
    assert Dropout(0.4).eval()(x) is x
    assert Dropout(0.0)(x) is x
    assert Dropout(1.0)(x).abs().sum() == 0


def test_the_seed_decides():
    x, dropout = torch.ones(1000), Dropout(0.5)
    torch.manual_seed(3)
    first = dropout(x)
    assert not torch.equal(first, dropout(x))
    torch.manual_seed(3)
    assert torch.equal(first, dropout(x))
