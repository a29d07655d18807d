"""Which frames of clips go together in a convolution by Winograd's minimal filtering."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

PRODUCTS, OUTPUTS = 6, 4  # of a tile


@dataclass(frozen=True, eq=False)
class WinogradTiles:
    """Tiles of frames: each takes six of them and makes four.

    Attributes:
        taken: (M, 6) int64, the frames that a tile takes; -1 for zeros.
        made: (M, 4) int64, the frames that it makes, every frame once; -1 for none.
        frames: How many there are.

    Raises:
        ValueError: If a frame is not one of them, or is not made once.
    """

    taken: Int[Tensor, "M 6"]
    made: Int[Tensor, "M 4"]
    frames: int

    def __post_init__(self) -> None:
        for name, rows, each in (("taken", self.taken, PRODUCTS), ("made", self.made, OUTPUTS)):
            if rows.shape != (len(self.taken), each) or rows.dtype != torch.int64:
                came = f"{rows.dtype} of {tuple(rows.shape)}"
                raise ValueError(f"`{name}` must be int64 of shape ({len(self.taken)}, {each}), got {came}.")
            if len(rows) and not -1 <= int(rows.min()) <= int(rows.max()) < self.frames:
                came = f"{int(rows.min())} to {int(rows.max())}"
                raise ValueError(f"`{name}` must lie within [-1, {self.frames}), got {came}.")
        times = self.made[self.made >= 0].bincount(minlength=self.frames)
        if not (times == 1).all():
            frame = int((times != 1).nonzero()[0])
            raise ValueError(f"`made` must name every frame once, got {int(times[frame])} times {frame}.")

    @classmethod
    def of(cls, lengths: Sequence[int], distance: int) -> WinogradTiles:
        """Of clips that lie end to end, each of which has the same tiles in any company.

        Args:
            lengths: Frames of the clips.
            distance: Between a filter's taps (the convolution's dilation), and between a tile's frames.

        Raises:
            ValueError: If ``distance`` is not positive or a length is negative.
        """
        if distance < 1 or min(lengths, default=0) < 0:
            came = f"{distance} and {tuple(lengths)}"
            raise ValueError(f"`distance` must be positive and `lengths` not negative, got {came}.")
        taken, start = [torch.zeros(0, PRODUCTS, dtype=torch.int64)], 0
        steps = distance * torch.arange(-1, PRODUCTS - 1)
        for length in lengths:
            first = torch.arange(length)
            first = first[first // distance % OUTPUTS == 0]
            frames = first[:, None] + steps
            taken.append(torch.where((frames >= 0) & (frames < length), frames + start, -1))
            start += length
        tiles = torch.cat(taken)
        return cls(tiles, tiles[:, 1 : 1 + OUTPUTS].contiguous(), start)

    def __len__(self) -> int:
        return len(self.taken)
