"""Frozen convolutions, directly and by Winograd's filtering: values, both Jacobian products, company."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from controlmm import ops
from controlmm.generation.frozen_layers import FrozenConv
from controlmm.generation.winograd_layer import WinogradLayer

ROUNDING = {False: 5e-6, True: 3e-5}  # of float32 sums of 60 products of order 1, direct or by Winograd
LENGTHS = (21, 40, 9)
ways = pytest.mark.parametrize("is_long", [False, True])
dilations = pytest.mark.parametrize("dilation", [1, 3, 9])


def values(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def convolution(dilation: int, width: int = 3) -> nn.Conv1d:
    conv = nn.Conv1d(20, 24, width, padding=dilation * (width // 2), dilation=dilation)
    conv.weight.data = values(24, 20, width, seed=0) / (20 * width) ** 0.5
    conv.bias.data = values(24, seed=1)
    return conv.requires_grad_(False)


def plain(conv: nn.Conv1d, clips: Tensor) -> Tensor:
    """In float64."""
    weight, bias = conv.weight.double(), conv.bias.double()
    rows = clips.double().mT
    return nn.functional.conv1d(rows, weight, bias, padding=conv.padding[0], dilation=conv.dilation[0]).mT


@ways
@dilations
def test_a_frozen_convolution_is_the_convolution(is_long, dilation):
    conv, x, gradient = convolution(dilation), values(3, 40, 20, seed=2), values(3, 40, 24, seed=3)
    frozen = FrozenConv.of(conv, torch.float32, is_long=is_long)
    kinds = {"rtol": 0, "atol": ROUNDING[is_long]}
    leaf = x.double().requires_grad_()
    expected = plain(conv, leaf)
    (slope,) = torch.autograd.grad(expected, leaf, gradient.double())
    torch.testing.assert_close(frozen.forward(x).double(), expected.detach(), **kinds)
    torch.testing.assert_close(frozen.backward(gradient).double(), slope, **kinds)
    rectified = frozen.forward(x, is_rectified=True).double()
    torch.testing.assert_close(rectified, expected.detach().relu(), **kinds)
    tangent = frozen.forward(x, is_tangent=True).double()
    torch.testing.assert_close(tangent, expected.detach() - conv.bias.double(), **kinds)


@ways
@dilations
def test_clips_that_lie_end_to_end_do_not_see_each_other(is_long, dilation):
    frozen = FrozenConv.of(convolution(dilation), torch.float32, is_long=is_long)
    x, gradient = values(1, sum(LENGTHS), 20, seed=4), values(1, sum(LENGTHS), 24, seed=5)
    together = frozen.forward(x, LENGTHS), frozen.backward(gradient, LENGTHS)
    for alone, whole in zip((frozen.forward, frozen.backward), together, strict=True):
        source = x if alone == frozen.forward else gradient
        for clip, own in zip(source.split(LENGTHS, 1), whole.split(LENGTHS, 1), strict=True):
            assert torch.equal(alone(clip), own)


@pytest.mark.skipif(not ops.available_isas(), reason="the C++ extension is not built")
def test_only_wide_float32_filters_over_many_frames_go_by_winograd():
    def is_quick(conv: FrozenConv) -> bool:
        return isinstance(conv._forward, WinogradLayer)

    assert is_quick(FrozenConv.of(convolution(1), torch.float32, is_long=True))
    assert not is_quick(FrozenConv.of(convolution(1), torch.float32))
    assert not is_quick(FrozenConv.of(convolution(1), torch.bfloat16, is_long=True))
    assert not is_quick(FrozenConv.of(convolution(1).double(), torch.float64, is_long=True))
    assert not is_quick(FrozenConv.of(convolution(1, width=1), torch.float32, is_long=True))
