"""Signed distances to obstacles in plain torch: the specification of the obstacle kernels."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.ops.obstacles import PackedObstacles
from controlmm.ops.reference import vector_length

# Points (B, T, J, 3) and one obstacle's parameters (B, T, 1, 16), the latter broadcast.
_Points = Float[Tensor, "B T J 3"]
_Parameters = Float[Tensor, "B T 1 16"]
_Distances = Float[Tensor, "B T J"]


def _sphere(points: _Points, p: _Parameters) -> _Distances:
    return vector_length(points - p[..., :3]) - p[..., 3]


def _capsule(points: _Points, p: _Parameters) -> _Distances:
    start, axis = p[..., :3], p[..., 3:6] - p[..., :3]
    squared = axis.square().sum(-1)
    along = ((points - start) * axis).sum(-1) / torch.where(squared == 0, 1, squared)
    return vector_length(points - start - axis * along.clamp(0, 1)[..., None]) - p[..., 6]


def _box(points: _Points, p: _Parameters) -> _Distances:
    rotation = p[..., 6:15].unflatten(-1, (3, 3))
    local = ((points - p[..., :3])[..., None, :] @ rotation)[..., 0, :]
    beyond = local.abs() - p[..., 3:6]
    x, y, z = beyond.unbind(-1)
    # On ties the first axis; torch.amax would split the gradient.
    deepest = torch.where((x >= y) & (x >= z), x, torch.where(y >= z, y, z))
    return torch.where(deepest < 0, deepest, vector_length(beyond.relu()))


def _half_space(points: _Points, p: _Parameters) -> _Distances:
    return (points * p[..., :3]).sum(-1) - p[..., 3]


def _plane(points: _Points, p: _Parameters) -> _Distances:
    return _half_space(points, p).abs()


def _height_field(points: _Points, p: _Parameters, grid: Float[Tensor, "R C"]) -> _Distances:
    last = torch.tensor(grid.shape, dtype=points.dtype) - 1
    place = ((points[..., ::2] - p[..., :2]) / p[..., 2:4]).clamp(torch.zeros_like(last), last)
    cell = place.detach().nan_to_num(0).floor().clamp(max=last - 1)
    u, v = (place - cell).unbind(-1)
    i, k = cell.long().unbind(-1)
    low = torch.lerp(grid[i, k], grid[i, k + 1], v)
    high = torch.lerp(grid[i + 1, k], grid[i + 1, k + 1], v)
    return points[..., 1] - torch.lerp(low, high, u)


_DISTANCES: dict[int, Callable[[Tensor, Tensor], Tensor]] = {
    0: _sphere,
    1: _capsule,
    2: _box,
    3: _plane,
    4: _half_space,
}


def _distance(points: _Points, obstacles: PackedObstacles, index: int) -> _Distances:
    kind, first, rows, columns = obstacles.kinds[index].tolist()
    parameters = obstacles.parameters[:, index].transpose(-1, -2)[:, :, None]
    if kind in _DISTANCES:
        return _DISTANCES[kind](points, parameters)
    grid = obstacles.heights[first : first + rows * columns].unflatten(0, (rows, columns))
    return _height_field(points, parameters, grid)


def signed_distances(
    joints: Float[Tensor, "B T J 3"], obstacles: PackedObstacles
) -> Float[Tensor, "B T J O"]:
    """Distance in metres of every joint to the surface of every obstacle, negative inside.

    Args:
        joints: Global joint positions in metres, Y up.
        obstacles: The result of ``pack_obstacles``, of the dtype of ``joints``; still, or moving over T.
    """
    columns = [_distance(joints, obstacles, index) for index in range(len(obstacles))]
    return torch.stack(columns, dim=-1) if columns else joints.new_zeros(*joints.shape[:3], 0)


def obstacle_loss_reference(
    joints: Float[Tensor, "B T J 3"],
    obstacles: PackedObstacles,
    counts: Bool[Tensor, "B T J"],
    radii: Float[Tensor, "J"],
    margin: float,
    reduction: str,
) -> Float[Tensor, "B"]:
    """Sum or mean over counted joints, frames and obstacles of max(0, margin + radius - distance)."""
    points = torch.where(counts[..., None], joints, 0)
    total = points[:, :0].sum((1, 2, 3))  # zero, and part of the graph even without obstacles
    for index in range(len(obstacles)):
        depth = (margin + radii - _distance(points, obstacles, index)).relu()
        total = total + torch.where(counts, depth, 0).sum((1, 2))
    if reduction == "sum":
        return total
    return total / (counts.sum((1, 2)) * len(obstacles)).clamp(min=1)
