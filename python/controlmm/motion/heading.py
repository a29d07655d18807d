"""Where a body faces on the ground, and turns about the vertical."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.motion.skeleton import Skeleton


def heading(joints: Float[Tensor, "*F J 3"], skeleton: Skeleton) -> Float[Tensor, "*F"]:
    """Angle about Y, in radians, that turns +Z to where the hips and shoulders face."""
    right_hip, left_hip, right_shoulder, left_shoulder = skeleton.facing
    across = joints[..., left_hip, :] - joints[..., right_hip, :]
    across = across + joints[..., left_shoulder, :] - joints[..., right_shoulder, :]
    return torch.atan2(-across[..., 2], across[..., 0])


def turned(points: Float[Tensor, "*F J 3"], yaw: Tensor) -> Float[Tensor, "*F J 3"]:
    """Points turned left about Y by ``yaw`` radians, which broadcasts with the leading axes."""
    x, y, z = points.unbind(-1)
    return torch.stack([x * yaw.cos() + z * yaw.sin(), y, z * yaw.cos() - x * yaw.sin()], dim=-1)
