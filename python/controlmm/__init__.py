"""Text plus 3D control in, human motion out, on an ordinary computer.

Names are imported when they are first used, so that ``import controlmm`` is quick.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from controlmm.controls import (
        Avoid,
        Box,
        Capsule,
        HalfSpace,
        HeightField,
        JointControl,
        Objective,
        PathControl,
        Plane,
        PoseControl,
        Sphere,
        TimelineEntry,
        load_controls,
        save_controls,
    )
    from controlmm.motion.motion import Motion
    from controlmm.pipelines import ControlMM, GenerationResult, TLControl

try:
    __version__ = version("controlmm")
except PackageNotFoundError:  # used from a source tree without an installation
    __version__ = "0.0.0+source"

_HOME_OF = {
    "Avoid": "controlmm.controls",
    "Box": "controlmm.controls",
    "Capsule": "controlmm.controls",
    "ControlMM": "controlmm.pipelines",
    "GenerationResult": "controlmm.pipelines",
    "HalfSpace": "controlmm.controls",
    "HeightField": "controlmm.controls",
    "JointControl": "controlmm.controls",
    "Motion": "controlmm.motion.motion",
    "Objective": "controlmm.controls",
    "PathControl": "controlmm.controls",
    "Plane": "controlmm.controls",
    "PoseControl": "controlmm.controls",
    "Sphere": "controlmm.controls",
    "TLControl": "controlmm.pipelines",
    "TimelineEntry": "controlmm.controls",
    "load_controls": "controlmm.controls",
    "save_controls": "controlmm.controls",
}

__all__ = [
    "Avoid",
    "Box",
    "Capsule",
    "ControlMM",
    "GenerationResult",
    "HalfSpace",
    "HeightField",
    "JointControl",
    "Motion",
    "Objective",
    "PathControl",
    "Plane",
    "PoseControl",
    "Sphere",
    "TLControl",
    "TimelineEntry",
    "__version__",
    "load_controls",
    "save_controls",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'controlmm' has no attribute {name!r}")
    return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
