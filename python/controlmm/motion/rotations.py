"""Quaternions ``(w, x, y, z)`` and 6D rotations, as HumanML3D uses them. Rotations are active."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def quat_multiply(a: Float[Tensor, "*B 4"], b: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 4"]:
    """Hamilton product ``a b``: the rotation ``b`` followed by ``a``."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def quat_conjugate(q: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 4"]:
    """The inverse of unit quaternions."""
    return q * q.new_tensor([1, -1, -1, -1])


def quat_rotate(q: Float[Tensor, "*B 4"], v: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """``v`` turned by the unit quaternion ``q``; both broadcast against each other."""
    q, v = torch.broadcast_tensors(q, torch.nn.functional.pad(v, (0, 1)))
    axis, v = q[..., 1:], v[..., :3]
    cross = torch.linalg.cross(axis, v, dim=-1)
    turned: Tensor = v + 2 * (q[..., :1] * cross + torch.linalg.cross(axis, cross, dim=-1))
    return turned


def quat_between(source: Float[Tensor, "*B 3"], target: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 4"]:
    """Shortest rotation from ``source`` to ``target`` (any lengths), with ``w >= 0``.

    NaN where the two are exactly antiparallel: the axis is undefined there, as in the public scripts, which
    skip such clips.
    """
    source, target = torch.broadcast_tensors(source, target)
    lengths = (source.square().sum(-1, keepdim=True) * target.square().sum(-1, keepdim=True)).sqrt()
    w = lengths + (source * target).sum(-1, keepdim=True)
    q = torch.cat([w, torch.linalg.cross(source, target, dim=-1)], dim=-1)
    unit: Tensor = q / q.norm(dim=-1, keepdim=True)
    return unit


def quat_to_matrix(q: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 3 3"]:
    """Rotation matrices of quaternions that need not have unit length."""
    w, x, y, z = q.unbind(-1)
    s = 2 / q.square().sum(-1)
    rows = [
        1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w),
        s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w),
        s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y),
    ]  # fmt: skip
    matrices: Tensor = torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
    return matrices


def matrix_to_rot6d(matrix: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 6"]:
    """The first two columns, one after the other (not the two rows that PyTorch3D takes)."""
    return torch.cat([matrix[..., 0], matrix[..., 1]], dim=-1)


def rot6d_to_matrix(rot6d: Float[Tensor, "*B 6"]) -> Float[Tensor, "*B 3 3"]:
    """Rotation matrices of 6D rotations (Zhou et al., CVPR 2019), columns as in :func:`matrix_to_rot6d`."""
    x = torch.nn.functional.normalize(rot6d[..., :3], dim=-1)
    z = torch.nn.functional.normalize(torch.linalg.cross(x, rot6d[..., 3:], dim=-1), dim=-1)
    return torch.stack([x, torch.linalg.cross(z, x, dim=-1), z], dim=-1)


def yaw_matrix(degrees: float) -> Float[Tensor, "3 3"]:
    """Rotation about the vertical axis Y; positive turns to the left, from +Z towards +X."""
    angle = torch.tensor(degrees, dtype=torch.float64).deg2rad()
    sine, cosine = float(angle.sin()), float(angle.cos())
    return torch.tensor([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
