"""Obstacles as signed-distance primitives: tensors only, static or moving frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

PARAMETERS = 16  # columns of the packed form, the same for every kind

# Anything torch.as_tensor takes. A moving obstacle adds leading axes: (T, ...) or (B, T, ...).
Values = Tensor | Sequence[object] | float


def _as_field(value: Values, name: str, shape: tuple[int, ...]) -> Tensor:
    """A float tensor of ``shape``, or with frame or batch and frame axes before it."""
    tensor = torch.as_tensor(value)
    if not tensor.is_floating_point():
        tensor = tensor.to(torch.float32)
    leading = tensor.ndim - len(shape)
    if leading not in (0, 1, 2) or tensor.shape[leading:] != shape:
        raise ValueError(
            f"`{name}` must have shape {shape}, (T, *{shape}) or (B, T, *{shape}), got {tuple(tensor.shape)}."
        )
    if not bool(tensor.detach().isfinite().all()):
        raise ValueError(f"`{name}` must be finite, got NaN or infinity.")
    return tensor


def _as_size(value: Values, name: str, shape: tuple[int, ...]) -> Tensor:
    tensor = _as_field(value, name, shape)
    if bool((tensor.detach() < 0).any()):
        raise ValueError(f"`{name}` must not be negative, got {tensor.detach().min().item():g} m.")
    return tensor


def _as_direction(value: Values, name: str) -> Tensor:
    tensor = _as_field(value, name, (3,))
    length = torch.linalg.vector_norm(tensor, dim=-1, keepdim=True)
    if bool((length.detach() == 0).any()):
        raise ValueError(f"`{name}` must have a length above 0, got a zero vector.")
    unit: Tensor = tensor / length
    return unit


def _joined(*fields: tuple[Tensor, int]) -> Float[Tensor, "B T P"]:
    """Fields side by side: each is (tensor, number of its own axes); the others are batch and frames."""
    columns = []
    for tensor, own in fields:
        leading = tensor.shape[: tensor.ndim - own]
        columns.append(tensor.reshape(*(1,) * (2 - len(leading)), *leading, -1))
    batch, frames = (max(column.shape[axis] for column in columns) for axis in (0, 1))
    return torch.cat([column.expand(batch, frames, -1) for column in columns], dim=-1)


@dataclass(frozen=True, eq=False)
class Sphere:
    """A solid ball: ``center`` (3,) and ``radius`` () in metres; either may move, (T, ...) or (B, T, ...).

    Example: ``Sphere(center=(0.5, 0.9, 1.5), radius=0.4)``.

    Raises:
        ValueError: If a shape does not fit, a value is not finite or the radius is negative.
    """

    center: Tensor
    radius: Tensor

    kind: ClassVar[int] = 0

    def __init__(self, center: Values, radius: Values):
        object.__setattr__(self, "center", _as_field(center, "center", (3,)))
        object.__setattr__(self, "radius", _as_size(radius, "radius", ()))

    def parameters(self) -> Float[Tensor, "B T 4"]:
        """Columns of the packed form: center, radius."""
        return _joined((self.center, 1), (self.radius, 0))


@dataclass(frozen=True, eq=False)
class Capsule:
    """A solid rod with round ends: points ``start`` and ``end`` (3,) and ``radius`` () in metres; all may
    move.

    Raises:
        ValueError: If a shape does not fit, a value is not finite or the radius is negative.
    """

    start: Tensor
    end: Tensor
    radius: Tensor

    kind: ClassVar[int] = 1

    def __init__(self, start: Values, end: Values, radius: Values):
        object.__setattr__(self, "start", _as_field(start, "start", (3,)))
        object.__setattr__(self, "end", _as_field(end, "end", (3,)))
        object.__setattr__(self, "radius", _as_size(radius, "radius", ()))

    def parameters(self) -> Float[Tensor, "B T 7"]:
        """Columns of the packed form: start, end, radius."""
        return _joined((self.start, 1), (self.end, 1), (self.radius, 0))


@dataclass(frozen=True, eq=False)
class Box:
    """A solid box: ``center`` and ``half_extents`` (3,) in metres, ``rotation`` (3, 3) from box to world
    axes.

    Raises:
        ValueError: If a shape does not fit, a value is not finite, an extent is negative, or the rotation is
            none.
    """

    center: Tensor
    half_extents: Tensor
    rotation: Tensor

    kind: ClassVar[int] = 2

    def __init__(self, center: Values, half_extents: Values, rotation: Values | None = None):
        turn = torch.eye(3) if rotation is None else _as_field(rotation, "rotation", (3, 3))
        excess = (turn.detach().mT @ turn.detach() - torch.eye(3, dtype=turn.dtype)).abs().max().item()
        if excess > 1e-3:
            raise ValueError(
                f"`rotation` must be orthonormal, got a matrix whose product with its transpose differs "
                f"from the identity by {excess:.2g}."
            )
        object.__setattr__(self, "center", _as_field(center, "center", (3,)))
        object.__setattr__(self, "half_extents", _as_size(half_extents, "half_extents", (3,)))
        object.__setattr__(self, "rotation", turn)

    def parameters(self) -> Float[Tensor, "B T 15"]:
        """Columns of the packed form: center, half extents, rotation row by row."""
        return _joined((self.center, 1), (self.half_extents, 1), (self.rotation, 2))


@dataclass(frozen=True, eq=False)
class Plane:
    """A thin endless wall through ``point`` (3,) across ``normal`` (3,); joints may be on either side, not
    near it.

    Raises:
        ValueError: If a shape does not fit, a value is not finite or the normal is zero.
    """

    point: Tensor
    normal: Tensor  # unit length

    kind: ClassVar[int] = 3

    def __init__(self, point: Values, normal: Values):
        object.__setattr__(self, "point", _as_field(point, "point", (3,)))
        object.__setattr__(self, "normal", _as_direction(normal, "normal"))

    def parameters(self) -> Float[Tensor, "B T 4"]:
        """Columns of the packed form: normal, offset along it."""
        both = _joined((self.normal, 1), (self.point, 1))
        offset = (both[..., :3] * both[..., 3:]).sum(-1, keepdim=True)
        return torch.cat([both[..., :3], offset], dim=-1)


@dataclass(frozen=True, eq=False, init=False)
class HalfSpace(Plane):
    """Everything behind a plane is solid: ``normal`` points out of it. ``HalfSpace((0, 0, 0), (0, 1, 0))`` is
    a floor.

    Raises:
        ValueError: If a shape does not fit, a value is not finite or the normal is zero.
    """

    kind: ClassVar[int] = 4


@dataclass(frozen=True, eq=False)
class HeightField:
    """Solid ground below the bilinear surface through ``heights`` (rows along x, columns along z) in metres.

    Sample (i, k) lies at x = origin[0] + i * spacing[0], z = origin[1] + k * spacing[1]. The distance is
    vertical, and the border continues outwards. ``origin`` and ``spacing`` (2,) in metres may move.

    Raises:
        ValueError: If there are fewer than 2 x 2 samples, a value is not finite, or the spacing is not
            positive.
    """

    heights: Tensor
    origin: Tensor
    spacing: Tensor

    kind: ClassVar[int] = 5

    def __init__(self, heights: Values, origin: Values, spacing: Values):
        grid = torch.as_tensor(heights)
        if grid.ndim != 2 or min(grid.shape) < 2:
            raise ValueError(f"`heights` must have at least 2 x 2 samples, got shape {tuple(grid.shape)}.")
        object.__setattr__(self, "heights", _as_field(grid, "heights", tuple(grid.shape)))
        object.__setattr__(self, "origin", _as_field(origin, "origin", (2,)))
        object.__setattr__(self, "spacing", _as_size(spacing, "spacing", (2,)))
        if bool((self.spacing.detach() == 0).any()):
            raise ValueError("`spacing` must be above 0 m, got 0.")

    def parameters(self) -> Float[Tensor, "B T 4"]:
        """Columns of the packed form: origin, spacing."""
        return _joined((self.origin, 1), (self.spacing, 1))


Obstacle = Sphere | Capsule | Box | Plane | HalfSpace | HeightField


@dataclass(frozen=True, eq=False)
class PackedObstacles:
    """Obstacles in the form the kernels read; make it once with ``pack_obstacles`` and reuse it."""

    kinds: Int[Tensor, "O 4"]  # kind; of a height field also first sample, rows, columns
    parameters: Float[Tensor, "B O 16 T"]  # batch and frames are 1 where nothing differs
    heights: Float[Tensor, "H"]  # samples of all height fields

    def __len__(self) -> int:
        return self.kinds.shape[0]


def pack_obstacles(obstacles: Sequence[Obstacle], *, dtype: torch.dtype = torch.float32) -> PackedObstacles:
    """The obstacles as three tensors, of ``dtype``, for repeated calls of ``obstacle_loss`` and guidance.

    Raises:
        TypeError: If an entry is no obstacle.
        ValueError: If obstacles move over different numbers of frames or clips.
    """
    rows, grids, kinds, samples = [], [], [], 0
    for obstacle in obstacles:
        if not isinstance(obstacle, Obstacle):
            raise TypeError(f"`obstacles` must hold obstacles such as Sphere, got {type(obstacle).__name__}.")
        rows.append(obstacle.parameters().to(dtype))
        shape = obstacle.heights.shape if isinstance(obstacle, HeightField) else (0, 0)
        kinds.append([obstacle.kind, samples, *shape])
        if isinstance(obstacle, HeightField):
            grids.append(obstacle.heights.to(dtype).reshape(-1))
            samples += grids[-1].numel()
    heights = torch.cat(grids) if grids else torch.zeros(0, dtype=dtype)
    return PackedObstacles(
        torch.tensor(kinds, dtype=torch.int64).reshape(-1, 4), _stacked(rows, dtype), heights
    )


def _stacked(rows: list[Tensor], dtype: torch.dtype) -> Float[Tensor, "B O 16 T"]:
    """All obstacles over their common batch and frames, frames last: that is how the kernels walk."""
    if not rows:
        return torch.zeros(1, 0, PARAMETERS, 1, dtype=dtype)
    extents = [sorted({row.shape[axis] for row in rows} - {1}) for axis in (0, 1)]
    for name, found in zip(("clips", "frames"), extents, strict=True):
        if len(found) > 1:
            raise ValueError(f"`obstacles` must move over one number of {name}, got {found}.")
    batch, frames = (found[0] if found else 1 for found in extents)
    padded = [torch.nn.functional.pad(row, (0, PARAMETERS - row.shape[-1])) for row in rows]
    stacked = torch.stack([row.expand(batch, frames, -1) for row in padded], dim=1)
    return stacked.transpose(-1, -2).contiguous()
