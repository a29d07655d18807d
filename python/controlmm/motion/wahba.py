"""The rotation that carries one set of vectors onto another with the least squared error (Wahba's problem).

Source: Horn, "Closed-form solution of absolute orientation using unit quaternions", 1987. The answer is the
eigenvector of a 4 x 4 matrix, a proper rotation for any input, flat and collinear ones included.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

# Weight of the prior relative to the vectors: only decides what the vectors leave open.
_PRIOR_WEIGHT = 1e-10


def best_rotation(
    source: Float[Tensor, "C 3"],
    target: Float[Tensor, "T C 3"],
    *,
    prior: Float[Tensor, "T 4"] | None = None,
) -> Float[Tensor, "T 4"]:
    """Unit quaternions ``(w, x, y, z)`` that minimise ``sum |target - R source|^2`` in every frame.

    Args:
        source: Vectors before the rotation; any unit.
        target: The same vectors after it, for each frame.
        prior: Rotation to stay near where the vectors leave one open (collinear or zero); ``None``: identity.
    """
    moments = source.T @ target  # (T, 3, 3), [i, j] = sum of source_i target_j
    if prior is None:
        prior = moments.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(target), 4)
    scale = moments.flatten(1).norm(dim=1) * _PRIOR_WEIGHT + torch.finfo(moments.dtype).tiny ** 0.5
    matrix = _horn_matrix(moments) + scale[:, None, None] * prior[:, :, None] * prior[:, None, :]
    _, vectors = torch.linalg.eigh(matrix)
    best = vectors[..., -1]
    return torch.where((best * prior).sum(-1, keepdim=True) < 0, -best, best)


def _horn_matrix(m: Float[Tensor, "T 3 3"]) -> Float[Tensor, "T 4 4"]:
    """The symmetric matrix whose largest eigenvector is the rotation's quaternion (Horn, section 4.A)."""
    trace = m.diagonal(dim1=-2, dim2=-1).sum(-1)
    axis = torch.stack([m[:, 1, 2] - m[:, 2, 1], m[:, 2, 0] - m[:, 0, 2], m[:, 0, 1] - m[:, 1, 0]], dim=-1)
    result = m.new_empty(len(m), 4, 4)
    result[:, 0, 0] = trace
    result[:, 0, 1:] = axis
    result[:, 1:, 0] = axis
    result[:, 1:, 1:] = m + m.mT - trace[:, None, None] * torch.eye(3, dtype=m.dtype)
    return result
