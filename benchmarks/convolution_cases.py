"""The decoder's convolutions: Winograd's filtering against torch's own and against one product."""

from __future__ import annotations

from collections.abc import Callable

import torch

from benchmarks.cases import Workload
from controlmm import ops
from controlmm.generation.frozen_layers import FrozenConv

FRAMES, DISTANCE = 102, 3  # of a clip after the first doubling, its ends shown twice; between taps


@torch.no_grad()
def convolutions(batch: int) -> list[Workload]:
    """Forward, at the width of the shipped model's decoder and at the papers'."""
    return [_convolution(batch, width) for width in (192, 512)]


def _convolution(batch: int, width: int) -> Workload:
    torch.manual_seed(0)
    conv = torch.nn.Conv1d(width, width, 3, padding=DISTANCE, dilation=DISTANCE).requires_grad_(False)
    lengths = (FRAMES,) * batch
    x = torch.randn(1, FRAMES * batch, width)
    channels_first = x.view(batch, FRAMES, width).mT.contiguous()
    tiles, matrices = (
        ops.WinogradTiles.of(lengths, DISTANCE),
        ops.winograd_weights(conv.weight).mT.contiguous(),
    )
    direct = FrozenConv.of(conv, torch.float32)

    def winograd(backend: ops.Backend) -> Callable[[], object]:
        def run() -> object:
            products = ops.winograd_parts(x[0], tiles, backend=backend) @ matrices
            return ops.winograd_frames(products, tiles, conv.bias, backend=backend)

        return run

    contenders = {
        "public": winograd("native"),
        "twin": winograd("reference"),
        "one product": lambda: direct.forward(x, lengths),
        "torch": lambda: conv(channels_first),
    }
    return Workload(f"convolution of width 3, {width} channels", contenders)
