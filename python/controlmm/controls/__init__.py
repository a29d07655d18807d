"""Spatial controls: joints, ground paths, poses, obstacles, objectives, timelines; files; dense form."""

from controlmm.controls.avoid import Avoid, as_avoids
from controlmm.controls.clearance import check_kept_clear, check_targets_clear, penetration
from controlmm.controls.dense import DenseControls, densify, stack_dense
from controlmm.controls.file import ControlFile, load_controls, save_controls
from controlmm.controls.joint import JointControl
from controlmm.controls.objective import Objective
from controlmm.controls.parts import PARTS, part_joints
from controlmm.controls.path import PathControl
from controlmm.controls.pose import PoseControl
from controlmm.controls.samples import Control, ControlSamples
from controlmm.controls.timeline import TimelineEntry, check_timeline
from controlmm.motion.rotations import yaw_matrix
from controlmm.ops import Box, Capsule, HalfSpace, HeightField, Obstacle, Plane, Sphere

__all__ = [
    "PARTS",
    "Avoid",
    "Box",
    "Capsule",
    "Control",
    "ControlFile",
    "ControlSamples",
    "DenseControls",
    "HalfSpace",
    "HeightField",
    "JointControl",
    "Objective",
    "Obstacle",
    "PathControl",
    "Plane",
    "PoseControl",
    "Sphere",
    "TimelineEntry",
    "as_avoids",
    "check_kept_clear",
    "check_targets_clear",
    "check_timeline",
    "densify",
    "load_controls",
    "part_joints",
    "penetration",
    "save_controls",
    "stack_dense",
    "yaw_matrix",
]
