"""Spatial controls: joints, ground paths and poses; their files; their dense form."""

from controlmm.controls.dense import DenseControls, densify, stack_dense
from controlmm.controls.file import ControlFile, load_controls, save_controls
from controlmm.controls.joint import JointControl
from controlmm.controls.path import PathControl
from controlmm.controls.pose import PoseControl
from controlmm.controls.samples import Control, ControlSamples

__all__ = [
    "Control",
    "ControlFile",
    "ControlSamples",
    "DenseControls",
    "JointControl",
    "PathControl",
    "PoseControl",
    "densify",
    "load_controls",
    "save_controls",
    "stack_dense",
]
