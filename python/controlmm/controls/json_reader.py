"""Reads the JSON form of controls (version 1), shared by Python, the command line and the viewer."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, TypeVar

from controlmm.controls.document import HEADER, ControlFile
from controlmm.controls.joint import JointControl
from controlmm.controls.json_obstacles import parse_obstacle
from controlmm.controls.json_timeline import parse_entry
from controlmm.controls.json_values import (
    PlacedError,
    check_constant,
    check_frames,
    check_joint,
    check_keys,
    check_number,
    check_points,
    check_type,
    shown,
)
from controlmm.controls.path import PathControl
from controlmm.controls.pose import PoseControl
from controlmm.controls.samples import Control

_Item = TypeVar("_Item")
_LISTS = ("controls", "obstacles", "timeline")


def parse_json(content: bytes) -> ControlFile:
    """The controls in a JSON document.

    Raises:
        ValueError: If the document is broken; the message names the line, or the place such as
            ``controls[1].positions[3]``.
    """
    document = _decode(content)
    check_type(document, "", dict, "an object")
    needed = () if any(name in document for name in _LISTS[1:]) else ("controls",)
    check_keys(document, "", required=(*HEADER, *needed), optional=("prompt", "seconds", *_LISTS))
    for key, expected in HEADER.items():
        check_constant(document[key], key, expected)
    if "prompt" in document:
        check_type(document["prompt"], "prompt", str, "a string")
    if "seconds" in document:
        check_number(document["seconds"], "seconds")
    return ControlFile(
        _parse_list(document, "controls", _parse_control),
        seconds=document.get("seconds"),
        text=document.get("prompt"),
        obstacles=_parse_list(document, "obstacles", parse_obstacle),
        timeline=_parse_list(document, "timeline", parse_entry),
    )


def _parse_list(document: dict[str, Any], name: str, parse: Callable[[Any, str], _Item]) -> list[_Item]:
    items = document.get(name, [])
    check_type(items, name, list, "a list")
    return [parse(item, f"{name}[{index}]") for index, item in enumerate(items)]


def _decode(content: bytes) -> Any:
    try:
        return json.loads(content.decode("utf-8-sig"), object_pairs_hook=_object_without_doubles)
    except UnicodeDecodeError as error:
        raise ValueError(f"not a text file in UTF-8 (byte {error.start}).") from error
    except json.JSONDecodeError as error:
        raise ValueError(f"broken JSON at line {error.lineno}, column {error.colno}: {error.msg}.") from error
    except RecursionError as error:
        raise ValueError("broken JSON: the brackets are nested too deeply.") from error


def _object_without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    for position, key in enumerate(keys):
        if key in keys[:position]:
            raise ValueError(f'the key "{key}" is there twice in one object.')
    return dict(pairs)


def _parse_control(item: Any, where: str) -> Control:
    check_type(item, where, dict, "an object")
    kinds = ", ".join(_PARSERS)
    if "type" not in item:
        raise PlacedError(where, f'missing key "type". It must be one of: {kinds}.')
    kind = item["type"]
    if not isinstance(kind, str) or kind not in _PARSERS:
        raise PlacedError(f"{where}.type", f"must be one of {kinds}, got {shown(kind)}.")
    try:
        return _PARSERS[kind]({key: value for key, value in item.items() if key != "type"}, where)
    except PlacedError:
        raise
    except (TypeError, ValueError) as error:
        raise PlacedError(where, str(error)) from error


def _parse_joint(values: dict[str, Any], where: str) -> JointControl:
    check_keys(values, where, required=("joint", "frames", "positions"), optional=())
    check_joint(values["joint"], f"{where}.joint")
    check_frames(values["frames"], f"{where}.frames")
    check_points(values["positions"], f"{where}.positions", depth=2, width=3)
    return JointControl(**values)


def _parse_path(values: dict[str, Any], where: str) -> PathControl:
    check_keys(values, where, required=("xz",), optional=("joint", "frames"))
    if "joint" in values:
        check_joint(values["joint"], f"{where}.joint")
    if values.get("frames") is not None:
        check_frames(values["frames"], f"{where}.frames")
    check_points(values["xz"], f"{where}.xz", depth=2, width=2)
    return PathControl(**values)


def _parse_pose(values: dict[str, Any], where: str) -> PoseControl:
    check_keys(values, where, required=("frames", "positions"), optional=("joints",))
    if values.get("joints") is not None:
        check_type(values["joints"], f"{where}.joints", list, "a list of joints")
        for index, joint in enumerate(values["joints"]):
            check_joint(joint, f"{where}.joints[{index}]")
    check_frames(values["frames"], f"{where}.frames")
    check_points(values["positions"], f"{where}.positions", depth=3, width=3)
    return PoseControl(**values)


_PARSERS: dict[str, Callable[[dict[str, Any], str], Control]] = {
    "joint": _parse_joint,
    "path": _parse_path,
    "pose": _parse_pose,
}
