"""The unit of steps in latent space: standard deviations of what codes spread, direction by direction.

Codes fill few directions of their space (of the shipped model's 192, a third holds 99 % of their variance),
and a decoder has only ever seen sums of codes. A step that is short by the plain norm may leave all of them
far behind. Measured by the codes' covariance it stays among latents that the decoder knows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.nn.row_product import row_product

_LEAST_VARIANCE = (
    0.01  # of a direction, as a share of the mean: those that codes leave out cost ten times more
)


@dataclass(frozen=True, eq=False)
class CodeSpread:
    """Coordinates ``u`` of changes of latents, ``u @ matrix``, in standard deviations of sums of codes.

    Attributes:
        matrix: (C, C) symmetric.
    """

    matrix: Float[Tensor, "C C"]

    @classmethod
    def of_codebooks(cls, codebooks: Sequence[Float[Tensor, "K C"]]) -> CodeSpread:
        """Root of the covariance of sums of codes, one drawn from each book."""
        books = [torch.cov(codes.double().T) for codes in codebooks]
        variances, directions = torch.linalg.eigh(torch.stack(books).sum(0))
        if not variances.max() > 0:  # fresh codebooks: no direction is better than another
            return cls(torch.eye(len(variances)))
        deviations = (variances.clamp(min=0) + _LEAST_VARIANCE * variances.mean()).sqrt()
        return cls(((directions * deviations) @ directions.T).float())

    def change(self, steps: Float[Tensor, "N C"]) -> Float[Tensor, "N C"]:
        """What steps in standard deviations change of the latents."""
        return row_product(steps, self.matrix)

    def gradient(self, gradient: Float[Tensor, "N C"]) -> Float[Tensor, "N C"]:
        """A gradient in the steps, given that in the latents."""
        return row_product(gradient, self.matrix)
