"""1D convolutional encoder and decoder of the motion tokenizer (T2M-GPT / MoMask layout)."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

_DILATION_GROWTH = 3

DecoderEnds = Literal["zeros", "repeat"]


def check_ends(ends: str) -> None:
    """Raise ``ValueError`` unless ``ends`` is one of :data:`DecoderEnds`."""
    if ends not in get_args(DecoderEnds):
        raise ValueError(f"`decoder_ends` must be one of {get_args(DecoderEnds)}, got {ends!r}.")


class ResidualConvBlock(nn.Module):
    """ReLU, dilated convolution, ReLU, 1x1 convolution, dropout, plus the input."""

    def __init__(self, width: int, *, dilation: int, dropout: float) -> None:
        super().__init__()
        self.dilated = nn.Conv1d(width, width, 3, padding=dilation, dilation=dilation)
        self.pointwise = nn.Conv1d(width, width, 1)
        self.dropout = nn.Dropout(dropout)

    def forward(
        self, x: Float[Tensor, "B C T"], valid: Float[Tensor, "B 1 T"] | None
    ) -> Float[Tensor, "B C T"]:
        """One block; ``valid`` silences frames after the end of a clip."""
        hidden = self.pointwise(torch.relu(self.dilated(torch.relu(x))))
        return masked(x + self.dropout(hidden), valid)


class ResidualStack(nn.ModuleList):
    """``depth`` residual blocks with dilations in descending order (9, 3, 1 for three)."""

    def __init__(self, width: int, *, depth: int, dropout: float) -> None:
        dilations = [_DILATION_GROWTH**level for level in reversed(range(depth))]
        super().__init__(ResidualConvBlock(width, dilation=d, dropout=dropout) for d in dilations)

    def forward(
        self, x: Float[Tensor, "B C T"], valid: Float[Tensor, "B 1 T"] | None
    ) -> Float[Tensor, "B C T"]:
        """All blocks in turn."""
        for block in self:
            x = block(x, valid)
        return x


class ConvEncoder(nn.Module):
    """Frames to tokens: one vector for every ``downsample`` frames."""

    def __init__(
        self, in_dim: int, out_dim: int, *, width: int, depth: int, downsample: int, dropout: float
    ) -> None:
        super().__init__()
        stages = downsample.bit_length() - 1
        self.entry = nn.Conv1d(in_dim, width, 3, padding=1)
        self.down = nn.ModuleList(nn.Conv1d(width, width, 4, stride=2, padding=1) for _ in range(stages))
        self.stacks = nn.ModuleList(ResidualStack(width, depth=depth, dropout=dropout) for _ in range(stages))
        self.exit = nn.Conv1d(width, out_dim, 3, padding=1)

    def forward(
        self, x: Float[Tensor, "B D T"], valid: Bool[Tensor, "B T"] | None = None
    ) -> Float[Tensor, "B C L"]:
        """``T`` must be a multiple of ``downsample``. ``valid`` marks the frames of each clip (a prefix)."""
        masks = _mask_pyramid(valid, levels=len(self.down), dtype=x.dtype)
        x = masked(torch.relu(self.entry(masked(x, masks[0]))), masks[0])
        for down, stack, mask in zip(self.down, self.stacks, masks[1:], strict=True):
            x = stack(masked(down(x), mask), mask)
        return masked(self.exit(x), masks[-1])


class ConvDecoder(nn.Module):
    """Tokens to frames, the mirror image of :class:`ConvEncoder` with nearest-neighbour up-sampling.

    ``ends`` says what is seen beyond a clip: "zeros" (published), or its first and last token once more
    ("repeat"), whose frames are then cut off. With zeros the first and the last frame of a motion pop.
    """

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        *,
        width: int,
        depth: int,
        downsample: int,
        dropout: float,
        ends: DecoderEnds = "zeros",
    ) -> None:
        super().__init__()
        self.downsample, self.ends = downsample, ends
        stages = downsample.bit_length() - 1
        self.entry = nn.Conv1d(in_dim, width, 3, padding=1)
        self.stacks = nn.ModuleList(ResidualStack(width, depth=depth, dropout=dropout) for _ in range(stages))
        self.up = nn.ModuleList(nn.Conv1d(width, width, 3, padding=1) for _ in range(stages))
        self.smooth = nn.Conv1d(width, width, 3, padding=1)
        self.exit = nn.Conv1d(width, out_dim, 3, padding=1)

    def forward(
        self, x: Float[Tensor, "B C L"], valid: Bool[Tensor, "B T"] | None = None
    ) -> Float[Tensor, "B D T"]:
        """Channel-major frames, as the last convolution emits them and the fused kernels read them."""
        if self.ends == "zeros":
            return self._frames(x, valid)
        step = self.downsample
        if valid is None:
            return self._frames(torch.cat([x[..., :1], x, x[..., -1:]], dim=-1), None)[..., step:-step]
        tokens = valid[:, ::step].sum(1)
        index = torch.arange(-1, x.shape[-1] + 1, device=x.device).clamp(min=0)
        index = torch.minimum(index, (tokens - 1).clamp(min=0)[:, None])
        longer = torch.cat([valid.new_ones(len(valid), 2 * step), valid], dim=1)
        decoded = self._frames(x.gather(-1, index[:, None].expand(-1, x.shape[1], -1)), longer)
        return masked(decoded[..., step:-step], valid[:, None].to(x.dtype))

    def _frames(self, x: Float[Tensor, "B C L"], valid: Bool[Tensor, "B T"] | None) -> Float[Tensor, "B D T"]:
        masks = _mask_pyramid(valid, levels=len(self.up), dtype=x.dtype)[::-1]
        x = masked(torch.relu(self.entry(masked(x, masks[0]))), masks[0])
        for stack, up, (coarse, fine) in zip(self.stacks, self.up, pairwise(masks), strict=True):
            x = stack(x, coarse)
            x = masked(up(torch.repeat_interleave(x, 2, dim=-1)), fine)
        x = masked(torch.relu(self.smooth(x)), masks[-1])
        return masked(self.exit(x), masks[-1])


def masked(x: Float[Tensor, "B C T"], valid: Float[Tensor, "B 1 T"] | None) -> Float[Tensor, "B C T"]:
    """``x`` with frames after a clip's end set to zero.

    A convolution then sees the same zeros after a short clip as after the longest one of the batch, so a
    clip's result does not depend on its neighbours.
    """
    return x if valid is None else x * valid


def _mask_pyramid(valid: Tensor | None, *, levels: int, dtype: torch.dtype) -> list[Tensor | None]:
    """Masks for frames, half frames, ... : a coarse step is valid when its first frame is."""
    if valid is None:
        return [None] * (levels + 1)
    return [valid[:, None, :: 2**level].to(dtype) for level in range(levels + 1)]
