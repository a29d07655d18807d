"""The metric of Gauss-Newton: which residuals a small change of the latents can remove."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.generation.kinematic_rows import KinematicRows

_DAMPING = 0.03  # times the mean of the diagonal (Levenberg and Marquardt's lambda)
_MOST_UNKNOWNS = 400  # a dense matrix of this size costs no more than an evaluation of the decoder


class Metric:
    """``M = (A + damping)^-1`` for ``A = K G K^T``, the products of the Jacobian's rows.

    ``J^T M r`` is the step that removes the residual and moves the latents least. Of dense controls, a few
    neighbouring frames of a coordinate form one unknown, their sum; what is left inside such a group is
    weighed by one number.
    """

    def __init__(
        self,
        rows: KinematicRows,
        channels: Float[Tensor, "D T D T"],
        mask: Bool[Tensor, "T J 3"],
        *,
        damping: float = _DAMPING,
        most_unknowns: int = _MOST_UNKNOWNS,
    ) -> None:
        size = int(mask.sum())
        self._groups = None
        if size > most_unknowns:
            self._groups = Groups.of_neighbours(mask, -(-size // most_unknowns))
            rows = rows.summed(self._groups.index, self._groups.weight)
        matrix = rows.gram(channels)
        diagonal = matrix.diagonal()
        diagonal += damping * diagonal.mean()
        self._factor = torch.linalg.cholesky(matrix)
        self._rest = 0.0
        if self._groups is not None:
            self._rest = torch.cholesky_inverse(self._factor).diagonal().mean().item()

    def weigh(self, residual: Float[Tensor, "N"]) -> tuple[float, Float[Tensor, "N"]]:
        """``r^T M r / 2`` and ``M r``."""
        groups = self._groups
        reduced = residual if groups is None else groups.sum(residual)
        weights = torch.cholesky_solve(reduced[:, None], self._factor)[:, 0]
        if groups is not None:
            weights = groups.spread(weights - self._rest * reduced) + self._rest * residual
        return 0.5 * (residual @ weights).item(), weights


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

    def sum(self, values: Float[Tensor, "N"]) -> Float[Tensor, "M"]:
        """The weighted sums."""
        sums = values.new_zeros(int(self.index.max()) + 1)
        return sums.index_add_(0, self.index, values * self.weight)

    def spread(self, sums: Float[Tensor, "M"]) -> Float[Tensor, "N"]:
        """The transpose of :meth:`sum`."""
        return sums[self.index] * self.weight
