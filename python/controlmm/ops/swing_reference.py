"""Plain-torch twin of the kernel that turns local rotations as their bones swing."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize


def swing_rotations_reference(
    rotations: Float[Tensor, "T J-1 6"],
    before: Float[Tensor, "T J 3"],
    after: Float[Tensor, "T J 3"],
    heading: Float[Tensor, "T 4"],
    parents: Sequence[int],
    starts: Sequence[bool],
) -> Float[Tensor, "T J-1 6"]:
    """See :func:`controlmm.ops.swing_rotations`. ``starts`` are true for joints relative to the heading."""
    columns = rotations.unflatten(-1, (2, 3)).mT  # (T, J-1, 3, 2)
    own, up = _of_columns(columns), list(parents[1:])
    swings = _shortest_rotations(*(x[:, 1:] - x[:, up] for x in (before, after)))  # (T, J-1, 3, 3)
    facing = _of_quaternions(heading[:, :1], heading[:, 1:])
    old, new, turned = [facing], [facing], []
    for joint in range(1, len(parents)):
        carrier = 0 if starts[joint] else parents[joint]
        swung = swings[:, joint - 1] @ old[carrier]
        turned.append(new[carrier].mT @ swung @ columns[:, joint - 1])
        old.append(old[carrier] @ own[:, joint - 1])
        new.append(swung @ own[:, joint - 1])
    return torch.stack(turned, dim=1).mT.flatten(-2)


def _of_columns(columns: Float[Tensor, "*B 3 2"]) -> Float[Tensor, "*B 3 3"]:
    """Which need be neither unit vectors nor at right angles."""
    x = normalize(columns[..., 0], dim=-1)
    z = normalize(torch.linalg.cross(x, columns[..., 1]), dim=-1)
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)


def _shortest_rotations(source: Float[Tensor, "*B 3"], target: Float[Tensor, "*B 3"]) -> Tensor:
    """NaN where the two are opposite or one is zero."""
    lengths = (source.square().sum(-1) * target.square().sum(-1)).sqrt()
    w = lengths + (source * target).sum(-1)
    return _of_quaternions(w[..., None], torch.linalg.cross(source, target))


def _of_quaternions(w: Float[Tensor, "*B 1"], v: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """``1 + 2 (w [v] + [v]^2) / (w^2 + v^2)``, where ``[v] u`` is the cross product of ``v`` and ``u``."""
    one = torch.eye(3, dtype=v.dtype, device=v.device)
    cross = torch.linalg.cross(*torch.broadcast_tensors(v[..., None, :], one)).mT
    squared = w.square() + v.square().sum(-1, keepdim=True)
    matrices: Tensor = one + (2 / squared)[..., None] * (w[..., None] * cross + cross @ cross)
    return matrices
