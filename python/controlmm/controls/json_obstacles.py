"""The JSON form of obstacles: read and written beside the controls."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from controlmm.controls.avoid import MARGIN, Avoid
from controlmm.controls.json_values import (
    PlacedError,
    check_frames,
    check_joint,
    check_keys,
    check_number,
    check_type,
    shown,
)
from controlmm.controls.shape_fields import SHAPE_NAMES, fields_of, shape_name
from controlmm.motion.rotations import yaw_matrix

_REQUIRED = {
    "sphere": ("center", "radius"),
    "capsule": ("start", "end", "radius"),
    "box": ("center", "half_extents"),
    "plane": ("point", "normal"),
    "half_space": ("point", "normal"),
    "height_field": ("heights", "origin", "spacing"),
}
_TURNS = ("rotation", "yaw")  # a box takes one of them
_OPTIONS = ("frames", "joints", "margin", "joint_radius")


def parse_obstacle(item: Any, where: str) -> Avoid:
    """One entry of ``obstacles``.

    Raises:
        ValueError: If it is broken; the message begins with the place.
    """
    check_type(item, where, dict, "an object")
    kinds = ", ".join(_REQUIRED)
    if "type" not in item:
        raise PlacedError(where, f'missing key "type". It must be one of: {kinds}.')
    kind = item["type"]
    if not isinstance(kind, str) or kind not in _REQUIRED:
        raise PlacedError(f"{where}.type", f"must be one of {kinds}, got {shown(kind)}.")
    values = {key: value for key, value in item.items() if key != "type"}
    turns = _TURNS if kind == "box" else ()
    check_keys(values, where, required=_REQUIRED[kind], optional=(*_OPTIONS, *turns))
    fields = {name: values[name] for name in (*_REQUIRED[kind], *turns) if name in values}
    for name, value in fields.items():
        _check_numbers(value, f"{where}.{name}")
    options = {name: values[name] for name in _OPTIONS if values.get(name) is not None}
    _check_options(options, where)
    try:
        return Avoid(SHAPE_NAMES[kind](**_with_rotation(fields)), **options)
    except (TypeError, ValueError) as error:
        raise PlacedError(where, str(error)) from error


def obstacle_as_dict(obstacle: Avoid) -> dict[str, Any]:
    """The JSON object of an obstacle; what has its default is left out."""
    values: dict[str, Any] = {"type": shape_name(obstacle.shape)}
    values |= {name: _numbers(value) for name, value in fields_of(obstacle.shape).items()}
    if obstacle.frames is not None:
        values["frames"] = obstacle.frames.tolist()
    if obstacle.joints is not None:
        values["joints"] = list(obstacle.joints)
    if obstacle.margin != MARGIN:
        values["margin"] = obstacle.margin
    if obstacle.joint_radius:
        values["joint_radius"] = obstacle.joint_radius
    return values


def _with_rotation(fields: dict[str, Any]) -> dict[str, Any]:
    if "yaw" not in fields:
        return fields
    if "rotation" in fields:
        raise ValueError('Give "rotation" or "yaw", not both.')
    yaw = fields.pop("yaw")
    if isinstance(yaw, list):
        raise ValueError('"yaw" must be one number in degrees. For a turning box give "rotation" rows.')
    return {**fields, "rotation": yaw_matrix(yaw).tolist()}


def _check_options(options: dict[str, Any], where: str) -> None:
    if "frames" in options:
        check_frames(options["frames"], f"{where}.frames")
    if "joints" in options:
        check_type(options["joints"], f"{where}.joints", list, "a list of joints")
        for index, joint in enumerate(options["joints"]):
            check_joint(joint, f"{where}.joints[{index}]")
    for name in ("margin", "joint_radius"):
        if name in options:
            check_number(options[name], f"{where}.{name}")


def _check_numbers(value: Any, where: str) -> None:
    """Refuse what is neither a finite number nor nested lists of them."""
    if not isinstance(value, list):
        check_number(value, where)
        return
    for index, item in enumerate(value):
        _check_numbers(item, f"{where}[{index}]")


def _numbers(values: Tensor) -> Any:
    """Nested lists of the shortest decimals that give back the same numbers."""
    array = values.detach().cpu().numpy()
    cells = np.array([float(str(value)) for value in array.ravel()], dtype=object)
    return cells.reshape(array.shape).tolist()
