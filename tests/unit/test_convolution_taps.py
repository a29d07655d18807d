"""Convolutions in place of others, against the layers that they stand for."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import conv1d

from controlmm.generation.convolution_taps import Taps


def layer(inputs: int, outputs: int, width: int) -> nn.Conv1d:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(width)
        return nn.Conv1d(inputs, outputs, width, padding=width // 2).double().requires_grad_(False)


def clips(*shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def applied(taps: Taps, x: Tensor) -> Tensor:
    return conv1d(x, taps.weight, taps.bias, padding=taps.weight.shape[2] // 2)


@pytest.mark.parametrize("width", [1, 3, 5, 7])
@pytest.mark.parametrize("frames", [1, 2, 9])
def test_doubled_frames_need_not_be_doubled(width, frames):
    conv, x = layer(4, 3, width), clips(2, 4, frames)
    expected = conv(x.repeat_interleave(2, dim=2))
    both = applied(Taps.of(conv).of_doubled_frames(), x)  # even results, then odd ones
    found = both.unflatten(1, (2, 3)).permute(0, 2, 3, 1).flatten(2)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("widths", [(3, 3), (1, 5), (5, 3)])
def test_two_convolutions_are_one_but_at_the_ends(widths):
    first, second = layer(4, 6, widths[0]), layer(6, 3, widths[1])
    x = clips(2, 4, 12)
    both, reach = Taps.of(first).then(Taps.of(second)), widths[1] // 2
    assert both.weight.shape == (3, 4, sum(widths) - 1)
    expected, found = second(first(x)), applied(both, x)
    inner = slice(reach, 12 - reach)
    torch.testing.assert_close(found[..., inner], expected[..., inner], rtol=1e-12, atol=1e-12)
    assert not torch.allclose(found[..., 0], expected[..., 0])


def test_strides_and_dilations_are_refused():
    for conv in (nn.Conv1d(2, 2, 3, stride=2), nn.Conv1d(2, 2, 3, dilation=3)):
        with pytest.raises(AssertionError):
            Taps.of(conv)
