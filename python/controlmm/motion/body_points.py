"""Points on the whole body, so that thin things cannot slip between two joints unnoticed."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.motion.skeleton import Skeleton

_INNER = (0.25, 0.5, 0.75)  # of the way along a bone; the longest, a shin, then has a point every 11 cm


def body_points(joints: Float[Tensor, "*B J 3"], skeleton: Skeleton) -> Float[Tensor, "*B P 3"]:
    """The joints and three points on each bone, ``P = J + 3 (J - 1)``, in the unit of the joints."""
    ends, starts = joints[..., 1:, :], joints[..., list(skeleton.parents[1:]), :]
    inner = [torch.lerp(starts, ends, share) for share in _INNER]
    return torch.cat([joints, *inner], dim=-2)
