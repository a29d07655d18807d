"""Writes the JSON form of controls (version 1)."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from torch import Tensor

from controlmm.controls.avoid import as_avoids
from controlmm.controls.document import HEADER, ControlFile
from controlmm.controls.joint import JointControl
from controlmm.controls.json_obstacles import obstacle_as_dict
from controlmm.controls.json_timeline import entry_as_dict
from controlmm.controls.path import PathControl
from controlmm.controls.pose import PoseControl
from controlmm.controls.samples import Control


def format_json(file: ControlFile) -> str:
    """The JSON document of ``file``, one line for each point, so that two versions compare well line by line.

    Raises:
        TypeError: If a control has no JSON form.
    """
    head = dict(HEADER)
    if file.text is not None:
        head["prompt"] = file.text
    if file.seconds is not None:
        head["seconds"] = file.seconds
    entries = [f'  "{key}": {json.dumps(value, ensure_ascii=False)}' for key, value in head.items()]
    lists = {
        "controls": [_as_dict(control) for control in file.controls],
        "obstacles": [obstacle_as_dict(obstacle) for obstacle in as_avoids(file.obstacles)],
        "timeline": [entry_as_dict(entry) for entry in file.timeline],
    }
    entries += [
        f'  "{name}": {_format_list(items)}' for name, items in lists.items() if items or name == "controls"
    ]
    return "\n".join(["{", ",\n".join(entries), "}", ""])


def _format_list(items: list[dict[str, Any]]) -> str:
    return "[\n" + ",\n".join(_format_item(item) for item in items) + "\n  ]" if items else "[]"


def _as_dict(control: Control) -> dict[str, Any]:
    if isinstance(control, JointControl):
        positions, frames = _numbers(control.positions, control.mask), control.frames.tolist()
        return {"type": "joint", "joint": control.joint, "frames": frames, "positions": positions}
    if isinstance(control, PathControl):
        held = {} if control.frames is None else {"frames": control.frames.tolist()}
        return {"type": "path", "joint": control.joint, **held, "xz": _numbers(control.xz)}
    if isinstance(control, PoseControl):
        joints = {} if control.joints is None else {"joints": list(control.joints)}
        positions = _numbers(control.positions, control.mask)
        return {"type": "pose", **joints, "frames": control.frames.tolist(), "positions": positions}
    raise TypeError(
        f"A {type(control).__name__} has no JSON form. Use JointControl, PathControl or PoseControl."
    )


def _numbers(points: Tensor, mask: Tensor | None = None) -> Any:
    """Nested lists of the shortest decimals that give back the same float32; ``None`` where free."""
    values = points.numpy()
    cells = np.array([float(str(value)) for value in values.ravel()], dtype=object).reshape(values.shape)
    if mask is not None:
        cells[~mask.numpy()] = None
    return cells.tolist()


def _format_item(values: dict[str, Any]) -> str:
    entries = [f'      "{key}": {_format_value(value)}' for key, value in values.items()]
    return "\n".join(["    {", ",\n".join(entries), "    }"])


def _format_value(value: Any) -> str:
    if not (isinstance(value, list) and value and isinstance(value[0], list)):
        return json.dumps(value, ensure_ascii=False)
    rows = ",\n".join(f"        {json.dumps(row)}" for row in value)
    return f"[\n{rows}\n      ]"
