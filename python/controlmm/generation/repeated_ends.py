"""Clips whose first and last token stand once more beyond their ends, as a decoder may see them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from controlmm.generation.clip_groups import Lengths


@dataclass(frozen=True, eq=False)
class RepeatedEnds:
    """Places of tokens among those of clips that lie end to end, each two tokens longer.

    Attributes:
        shown: (M,) the token that every place shows.
        own: (N,) the place of every token.
        ends: (E,) the first tokens of all clips, and (E,) the last ones.
        beyond: Places before the first ones and behind the last ones.
    """

    shown: Int[Tensor, "M"]
    own: Int[Tensor, "N"]
    ends: tuple[Int[Tensor, "E"], Int[Tensor, "E"]]
    beyond: tuple[Int[Tensor, "E"], Int[Tensor, "E"]]

    def added(self, tokens: Float[Tensor, "B N C"]) -> Float[Tensor, "B M C"]:
        """The tokens with the ends once more."""
        return tokens[:, self.shown]

    def pulled(self, gradient: Float[Tensor, "B M C"]) -> Float[Tensor, "B N C"]:
        """The transpose of :meth:`added`."""
        own = gradient[:, self.own]
        for end, beyond in zip(self.ends, self.beyond, strict=True):
            own[:, end] += gradient[:, beyond]
        return own

    def frames(self, step: int) -> Int[Tensor, "F"]:
        """Which frames are the clips' own, of places that take ``step`` frames."""
        return (self.own[:, None] * step + torch.arange(step)).flatten()


@lru_cache(maxsize=256)
def repeated_ends(lengths: Lengths) -> RepeatedEnds:
    """For clips of these lengths in tokens."""
    counts = torch.tensor(lengths)
    last = counts.cumsum(0) - 1
    first = last + 1 - counts
    clips = torch.arange(len(lengths))
    own = torch.arange(int(counts.sum())) + (2 * clips + 1).repeat_interleave(counts)
    before, behind = first + 2 * clips, last + 2 * clips + 2
    shown = torch.empty(len(own) + 2 * len(clips), dtype=torch.int64)
    shown[own] = torch.arange(len(own))
    shown[before], shown[behind] = first, last
    return RepeatedEnds(shown, own, (first, last), (before, behind))
