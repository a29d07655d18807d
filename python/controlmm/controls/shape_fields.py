"""The fields of obstacle shapes: which of them move, and how shapes are placed and spread over frames."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from controlmm.ops import Box, Capsule, HalfSpace, HeightField, Obstacle, Plane, Sphere

# Axes that belong to a field itself; one more axis, in front, means that it moves frame by frame.
_OWN_AXES = {
    "center": 1, "start": 1, "end": 1, "point": 1, "normal": 1, "origin": 1, "spacing": 1, "half_extents": 1,
    "radius": 0, "rotation": 2, "heights": 2,
}  # fmt: skip
_FIELDS: dict[type[Obstacle], tuple[str, ...]] = {
    Sphere: ("center", "radius"),
    Capsule: ("start", "end", "radius"),
    Box: ("center", "half_extents", "rotation"),
    Plane: ("point", "normal"),
    HalfSpace: ("point", "normal"),
    HeightField: ("heights", "origin", "spacing"),
}
_POINTS = ("center", "start", "end", "point")
_LENGTHS = ("radius", "half_extents", "spacing")
SHAPE_NAMES: dict[str, type[Obstacle]] = {
    "sphere": Sphere,
    "capsule": Capsule,
    "box": Box,
    "plane": Plane,
    "half_space": HalfSpace,
    "height_field": HeightField,
}


def shape_name(shape: Obstacle) -> str:
    """What files and messages call the shape, such as ``half_space``."""
    return next(name for name, kind in SHAPE_NAMES.items() if type(shape) is kind)


def fields_of(shape: Obstacle) -> dict[str, Tensor]:
    """The shape's tensors by name, in the order in which its class takes them."""
    return {name: getattr(shape, name) for name in _FIELDS[type(shape)]}


def moving_fields(shape: Obstacle) -> dict[str, Tensor]:
    """Those fields that have a frame axis.

    Raises:
        ValueError: If a field has a batch axis too, or the fields move over different numbers of frames.
    """
    moving = {name: value for name, value in fields_of(shape).items() if value.ndim > _OWN_AXES[name]}
    for name, value in moving.items():
        if value.ndim > _OWN_AXES[name] + 1:
            raise ValueError(
                f"`{name}` of a {shape_name(shape)} must have no or one axis of frames in front, "
                f"got shape {tuple(value.shape)}. All samples share their obstacles."
            )
    counts = {name: len(value) for name, value in moving.items()}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"`{name}` {count}" for name, count in counts.items())
        raise ValueError(f"All moving fields of a {shape_name(shape)} need one number of rows, got {listed}.")
    return moving


def placed(shape: Obstacle, *, offset: Float[Tensor, "3"], scale: float = 1.0) -> Obstacle:
    """The shape moved by ``offset`` metres, then all lengths multiplied by ``scale`` (1000: millimetres)."""

    def place(name: str, value: Tensor) -> Tensor:
        if name in _POINTS:
            return (value + offset.to(value)) * scale
        if name == "origin":
            return (value + offset.to(value)[[0, 2]]) * scale
        if name == "heights":
            return (value + offset.to(value)[1]) * scale
        return value * scale if name in _LENGTHS else value

    return _mapped(shape, place)


def spread(shape: Obstacle, frames: Int[Tensor, " N"] | None, num_frames: int) -> Obstacle:
    """A moving shape with a row for each of ``num_frames`` frames; a still one as it is.

    Args:
        shape: Its moving fields have N rows.
        frames: (N,) rising frame numbers of the rows; between them fields change linearly (rotations along
            the nearest rotation), before and after they stand still. ``None``: row i is frame i, and the
            last row stays.
        num_frames: Frames that are wanted.
    """
    moving = moving_fields(shape)
    if not moving:
        return shape
    rows = len(next(iter(moving.values())))
    known = torch.arange(rows) if frames is None else frames
    wanted = torch.arange(num_frames)
    upper = torch.searchsorted(known, wanted).clamp(max=rows - 1)
    lower = torch.where(known[upper] > wanted, (upper - 1).clamp(min=0), upper)
    gap = (known[upper] - known[lower]).clamp(min=1)
    share = ((wanted - known[lower]) / gap).clamp(0, 1)

    def interpolate(name: str, value: Tensor) -> Tensor:
        if name not in moving:
            return value
        weight = share.to(value).reshape(-1, *[1] * (value.ndim - 1))
        between = torch.lerp(value[lower], value[upper], weight)
        return _nearest_rotation(between) if name == "rotation" else between

    return _mapped(shape, interpolate)


def _mapped(shape: Obstacle, change: Callable[[str, Tensor], Tensor]) -> Obstacle:
    return type(shape)(**{name: change(name, value) for name, value in fields_of(shape).items()})


def _nearest_rotation(matrices: Float[Tensor, "T 3 3"]) -> Float[Tensor, "T 3 3"]:
    """Blends of two rotations less than half a turn apart, made orthonormal again."""
    left, _, right = torch.linalg.svd(matrices)
    rotations: Tensor = left @ right
    return rotations
