"""FID: Frechet distance between two clouds of embeddings, each taken for a Gaussian.

Source: Heusel et al., NIPS 2017; on motion embeddings since Guo et al., ICCV/CVPR 2020-2022.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def frechet_distance(a: Float[Tensor, "N E"], b: Float[Tensor, "M E"]) -> float:
    """``|m_a - m_b|^2 + tr(C_a + C_b - 2 (C_a C_b)^(1/2))`` with unbiased covariances, in float64.

    With ``C = R^T R`` the trace of the root is the sum of the singular values of ``R_a R_b^T``: no imaginary
    parts to drop, and singular covariances (fewer samples than dimensions) lose no digits.
    The value falls with the number of samples even for equal distributions: compare equal numbers only.

    Raises:
        ValueError: If the widths differ, or a cloud has fewer than two embeddings or one that is not finite.
    """
    for name, cloud in (("a", a), ("b", b)):
        if cloud.ndim != 2 or len(cloud) < 2:
            raise ValueError(f"`{name}` must be (N, E) with N >= 2, got {tuple(cloud.shape)}.")
        if not torch.isfinite(cloud).all():
            raise ValueError(f"`{name}` holds embeddings that are not finite; look for broken motions.")
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"`a` and `b` must have one width, got {a.shape[1]} and {b.shape[1]}.")
    mean_a, root_a = _moments(a)
    mean_b, root_b = _moments(b)
    shared = torch.linalg.svdvals(root_a @ root_b.T).sum()
    variances = root_a.square().sum() + root_b.square().sum()
    return float((mean_a - mean_b).square().sum() + variances - 2 * shared)


def _moments(cloud: Float[Tensor, "N E"]) -> tuple[Float[Tensor, "E"], Float[Tensor, "R E"]]:
    """Mean, and a triangular ``R`` with ``R^T R`` the covariance."""
    cloud = cloud.double()
    mean = cloud.mean(0)
    root: Tensor = torch.linalg.qr((cloud - mean) / (len(cloud) - 1) ** 0.5, mode="r").R
    return mean, root
