"""Plain-torch operators: the specification that every kernel is compared with. No cleverness here."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def recover_joints_reference(
    features: Float[Tensor, "*B T D"], joints: int = 22
) -> Float[Tensor, "*B T J 3"]:
    """Global joint positions of de-normalised HumanML3D features.

    Channel 0 is half the yaw velocity, 1-2 the root velocity in the heading frame of the next frame, 3 the
    root height, then joints 1..J-1 relative to the root (x, z) in the heading frame, y absolute.
    """
    half_turn = features[..., :-1, 0].cumsum(-1)
    yaw = 2 * torch.cat([torch.zeros_like(features[..., :1, 0]), half_turn], dim=-1)  # (B, T)
    cos, sin = yaw.cos(), yaw.sin()

    velocity = torch.cat([torch.zeros_like(features[..., :1, 1:3]), features[..., :-1, 1:3]], dim=-2)
    root_x = (cos * velocity[..., 0] - sin * velocity[..., 1]).cumsum(-1)
    root_z = (sin * velocity[..., 0] + cos * velocity[..., 1]).cumsum(-1)
    root = torch.stack([root_x, features[..., 3], root_z], dim=-1)

    local = features[..., 4 : 4 + 3 * (joints - 1)].unflatten(-1, (joints - 1, 3))  # (B, T, J-1, 3)
    cos, sin = cos[..., None], sin[..., None]
    x = cos * local[..., 0] - sin * local[..., 2] + root_x[..., None]
    z = sin * local[..., 0] + cos * local[..., 2] + root_z[..., None]
    return torch.cat([root[..., None, :], torch.stack([x, local[..., 1], z], dim=-1)], dim=-2)


def masked_consistency_loss_reference(
    joints: Float[Tensor, "B T J 3"],
    targets: Float[Tensor, "B T J 3"],
    mask: Bool[Tensor, "B T J 3"],
    norm: str = "l2",
    reduction: str = "batch",
) -> Float[Tensor, ""] | Float[Tensor, "B"]:
    """Distance of controlled joints to their targets (ControlMM, equation 4), or absolute or squared
    error."""
    difference = torch.where(mask, joints - targets, 0)
    if norm == "l2":
        penalty = vector_length(difference)
        count = mask.any(-1).sum((1, 2))
    else:
        penalty = difference.abs() if norm == "l1" else difference.square()
        penalty = penalty.sum(-1)
        count = mask.sum((1, 2, 3))
    total = penalty.sum((1, 2))
    if reduction == "batch":
        total, count = total.sum(), count.sum()
    return total / count.clamp(min=1)


def vector_length(vectors: Float[Tensor, "*S 3"]) -> Float[Tensor, "*S"]:
    """Euclidean length whose gradient at zero is zero, not NaN."""
    squared = vectors.square().sum(-1)
    is_zero = squared == 0
    return torch.where(is_zero, 0, torch.where(is_zero, 1, squared).sqrt())
