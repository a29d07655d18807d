"""Clips that networks take together, so that products have many rows.

What networks say of a clip depends neither on the clips beside it nor on how far they reach: attention takes
clips of one length, convolutions know where a clip ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Int
from torch import Tensor

Lengths = tuple[int, ...]  # of clips that lie end to end

_TOKENS = 784  # of 16 clips of 196 frames: what a layer makes of them stays in a processor's caches
_GROUP = 96  # tokens that take as long as what a group costs however small it is


def clips_of_like_length(lengths: Sequence[int]) -> list[Int[Tensor, "N"]]:
    """All clips in groups whose cost is least: tokens, padding included, and what a group costs by itself."""
    order = sorted(range(len(lengths)), key=lambda clip: lengths[clip])
    ways = [(0, 0)]  # for the first clips of the order: the least cost, and where the last group starts
    for end in range(1, len(order) + 1):
        longest = lengths[order[end - 1]]
        starts = range(max(0, end - max(1, _TOKENS // longest)), end)
        ways.append(min((ways[start][0] + (end - start) * longest + _GROUP, start) for start in starts))
    groups, end = [], len(order)
    while end:
        start = ways[end][1]
        groups.append(torch.tensor(order[start:end]))
        end = start
    return groups[::-1]


@dataclass(frozen=True, eq=False)
class EndToEnd:
    """Some clips of a padded batch without its padding, one behind the other.

    Attributes:
        clips: Which they are.
        lengths: Tokens of each.
        padded: Tokens of the batch.
        step: Frames of a token.
    """

    clips: tuple[int, ...]
    lengths: tuple[int, ...]
    padded: int
    step: int

    @cached_property
    def tokens(self) -> Int[Tensor, "N"]:
        """Where their tokens are in the flattened batch."""
        return self._places(1)

    @cached_property
    def frames(self) -> Int[Tensor, "N"]:
        """Where their frames are."""
        return self._places(self.step)

    def _places(self, step: int) -> Int[Tensor, "N"]:
        spans = zip(self.clips, self.lengths, strict=True)
        starts = [(clip * self.padded * step, length * step) for clip, length in spans]
        return torch.cat([torch.arange(start, start + length) for start, length in starts])


def clips_end_to_end(lengths: Sequence[int], *, padded: int, step: int) -> list[EndToEnd]:
    """All clips in their order, as many in a group as networks take well; ``lengths`` are tokens."""
    groups: list[list[int]] = []
    room = 0
    for clip, length in enumerate(lengths):
        if length > room:
            groups.append([])
            room = _TOKENS
        groups[-1].append(clip)
        room -= length
    return [EndToEnd(tuple(clips), tuple(lengths[clip] for clip in clips), padded, step) for clips in groups]
