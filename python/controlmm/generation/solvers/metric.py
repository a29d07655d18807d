"""The metric of Gauss-Newton: which residuals a small change of the latents can remove."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.generation.coordinate_groups import Groups

_DAMPING = 0.03  # times the mean of the diagonal (Levenberg and Marquardt's lambda)


class Metric:
    """``M = (A + damping)^-1`` for ``A``, the products of the Jacobian's rows.

    ``J^T M r`` is the step that removes the residual and moves the latents least. Of dense controls, a few
    neighbouring frames of a coordinate form one unknown, their sum; what is left inside such a group is
    weighed by one number.
    """

    def __init__(
        self,
        products: Float[Tensor, "M M"],
        groups: Groups | None = None,
        *,
        damping: float = _DAMPING,
    ) -> None:
        self._groups = groups
        matrix = products.double()
        diagonal = matrix.diagonal()
        diagonal += damping * diagonal.mean()
        self._inverse = torch.cholesky_inverse(torch.linalg.cholesky(matrix))
        self._latest: tuple[Tensor, tuple[float, Tensor]] | None = None
        self._rest = 0.0 if groups is None else self._inverse.diagonal().mean().item()

    def weigh(self, residual: Float[Tensor, "N"]) -> tuple[float, Float[Tensor, "N"]]:
        """``r^T M r / 2`` and ``M r``; both are asked for again as long as no target is shifted."""
        if self._latest is None or self._latest[0] is not residual:
            self._latest = residual, self._weighed(residual)
        return self._latest[1]

    def _weighed(self, residual: Float[Tensor, "N"]) -> tuple[float, Float[Tensor, "N"]]:
        groups = self._groups
        reduced = residual if groups is None else groups.sum(residual)
        weights = self._inverse @ reduced
        if groups is not None:
            weights = groups.spread(weights - self._rest * reduced) + self._rest * residual
        return 0.5 * (residual @ weights).item(), weights
