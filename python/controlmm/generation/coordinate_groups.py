"""Neighbouring frames of a controlled coordinate as one unknown: their sum."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

MOST_UNKNOWNS = 400  # a dense matrix of this size costs no more than an evaluation of the decoder


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
        """Groups so small that about ``most`` are left; ``None`` if there are no more coordinates."""
        size = int(mask.sum())
        return cls.of_neighbours(mask, -(-size // most)) if size > most else None

    @classmethod
    def of_neighbours(cls, mask: Bool[Tensor, "T J 3"], size: int) -> Groups:
        """Up to ``size`` successive controlled frames of a coordinate; coordinates as ``mask.nonzero()``."""
        frame, joint, axis = mask.nonzero().T
        coordinate = joint * 3 + axis
        order = (coordinate * len(mask) + frame).argsort()
        rank = torch.empty_like(order)
        rank[order] = torch.arange(len(order))
        first = torch.full((int(coordinate.max()) + 1,), len(order))
        first = first.scatter_reduce(0, coordinate, rank, "amin")
        block = (rank - first[coordinate]) // size
        _, index, counts = torch.unique(
            coordinate * len(mask) + block, return_inverse=True, return_counts=True
        )
        return cls(index, counts[index].double().rsqrt())

    def __len__(self) -> int:
        return int(self.index.max()) + 1 if len(self.index) else 0

    def sum(self, values: Float[Tensor, "N"]) -> Float[Tensor, "M"]:
        """The weighted sums."""
        sums = values.new_zeros(len(self))
        return sums.index_add_(0, self.index, values * self.weight)

    def spread(self, sums: Float[Tensor, "M"]) -> Float[Tensor, "N"]:
        """The transpose of :meth:`sum`."""
        return sums[self.index] * self.weight
