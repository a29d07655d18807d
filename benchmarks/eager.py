"""What the kernels are compared with: eager torch as public code writes it, and the best plain-torch form."""

from __future__ import annotations

import torch
from torch import Tensor

from controlmm.ops.reference import masked_consistency_loss_reference, recover_joints_reference


def _rotate_inverse(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Rotation of vectors by unit quaternions (w, x, y, z), through two cross products."""
    flat_quaternion, flat = quaternion.reshape(-1, 4), vector.reshape(-1, 3)
    axis = flat_quaternion[:, 1:]
    first = torch.cross(axis, flat, dim=1)
    second = torch.cross(axis, first, dim=1)
    return (flat + 2 * (flat_quaternion[:, :1] * first + second)).reshape(vector.shape)


def quaternion_joints(features: Tensor, joints: int = 22) -> Tensor:
    """Joints as the public code computes them: quaternions expanded to every joint."""
    half_angle = torch.zeros_like(features[..., 0])
    half_angle[..., 1:] = features[..., :-1, 0]
    half_angle = torch.cumsum(half_angle, dim=-1)
    turn = torch.zeros((*features.shape[:-1], 4), dtype=features.dtype)
    turn[..., 0] = torch.cos(half_angle)
    turn[..., 2] = torch.sin(half_angle)
    conjugate = torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=features.dtype)
    velocity = torch.zeros((*features.shape[:-1], 3), dtype=features.dtype)
    velocity[..., 1:, [0, 2]] = features[..., :-1, 1:3]
    root = torch.cumsum(_rotate_inverse(turn * conjugate, velocity), dim=-2)
    root[..., 1] = features[..., 3]
    local = features[..., 4 : 4 + 3 * (joints - 1)].reshape(*features.shape[:-1], -1, 3)
    expanded = (turn * conjugate)[..., None, :].expand(*local.shape[:-1], 4).contiguous()
    positions = _rotate_inverse(expanded, local)
    positions[..., 0] += root[..., 0:1]
    positions[..., 2] += root[..., 2:3]
    return torch.cat([root.unsqueeze(-2), positions], dim=-2)


lean_joints = recover_joints_reference


def eager_consistency(joints: Tensor, targets: Tensor, mask: Tensor) -> Tensor:
    """Mean distance of controlled joints to their targets, one value a clip."""
    return masked_consistency_loss_reference(joints, targets, mask, "l2", "clip")


def eager_gumbel(logits: Tensor, codebook: Tensor) -> Tensor:
    """Straight-through Gumbel softmax and codebook product with torch's own noise."""
    drawn = torch.nn.functional.gumbel_softmax(logits, tau=1.0, hard=True)
    return drawn @ codebook
