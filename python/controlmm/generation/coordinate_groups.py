"""Neighbouring frames of a controlled coordinate as one unknown: their sum."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

MOST_UNKNOWNS = 400  # a dense matrix of this size costs no more than an evaluation of the decoder
_FEW = 100  # so few coordinates stay as they are
_ROOT_SPAN = 4  # frames, those of a token: the root's way is smooth


@dataclass(frozen=True, eq=False)
class Groups:
    """Orthonormal sums of coordinates, each of which enters one.

    Attributes:
        index: (N,), the sum that a coordinate enters.
        weight: (N,), its factor there.
    """

    index: Int[Tensor, "N"]
    weight: Float[Tensor, "N"]

    @classmethod
    def of_many(cls, mask: Bool[Tensor, "T J 3"], most: int = MOST_UNKNOWNS) -> Groups | None:
        """Groups so small that about ``most`` are left; ``None`` if there are few coordinates.

        Those of the root, joint 0, are summed over spans of time, which loses nothing.
        """
        frame, joint, axis = mask.nonzero().T
        if len(frame) <= min(_FEW, most):
            return None
        coordinate, is_root, span = joint * 3 + axis, joint == 0, frame // _ROOT_SPAN
        left = most - len(torch.unique((coordinate * len(mask) + span)[is_root]))
        size = -(-int((~is_root).sum()) // max(1, left))
        block = torch.where(is_root, span, _rank(coordinate, frame) // max(1, size))
        return cls._of_blocks(coordinate * len(mask) + block)

    @classmethod
    def of_neighbours(cls, mask: Bool[Tensor, "T J 3"], size: int) -> Groups:
        """Up to ``size`` successive controlled frames of a coordinate; coordinates as ``mask.nonzero()``."""
        frame, joint, axis = mask.nonzero().T
        coordinate = joint * 3 + axis
        return cls._of_blocks(coordinate * len(mask) + _rank(coordinate, frame) // size)

    @classmethod
    def _of_blocks(cls, block: Int[Tensor, "N"]) -> Groups:
        _, index, counts = torch.unique(block, return_inverse=True, return_counts=True)
        return cls(index, counts[index].double().rsqrt())

    def __len__(self) -> int:
        return self._count

    @cached_property
    def _count(self) -> int:
        return int(self.index.max()) + 1 if len(self.index) else 0

    def sum(self, values: Float[Tensor, "N"]) -> Float[Tensor, "M"]:
        """The weighted sums."""
        sums = values.new_zeros(len(self))
        return sums.index_add_(0, self.index, values * self.weight)

    def spread(self, sums: Float[Tensor, "M"]) -> Float[Tensor, "N"]:
        """The transpose of :meth:`sum`."""
        return sums[self.index] * self.weight


def _rank(coordinate: Int[Tensor, "N"], frame: Int[Tensor, "N"]) -> Int[Tensor, "N"]:
    """Of each frame among those of its coordinate."""
    order = (coordinate * (1 + int(frame.max())) + frame).argsort()
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order))
    first = torch.full((int(coordinate.max()) + 1,), len(order))
    first = first.scatter_reduce(0, coordinate, rank, "amin")
    return rank - first[coordinate]
