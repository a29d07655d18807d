"""Writes a rotation fit as a BVH file.

Conventions: Y up, T-pose at rest facing +Z with the left arm along +X, joints depth first, rotations as
``Zrotation Xrotation Yrotation`` in degrees (matrix ``Rz Rx Ry``) for every joint, position channels for the
root alone, whose OFFSET is zero. Z-X-Y is the order most readers of this field assume; it also keeps angle
curves smooth for these skeletons (only a knee bent by a right angle comes near its lock).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from controlmm.io.atomic import replaced_on_success
from controlmm.io.euler import continuous_euler
from controlmm.motion.rotation_fit import RotationFit
from controlmm.motion.rotations import quat_to_matrix
from controlmm.motion.skeleton import Skeleton
from controlmm.motion.t_pose import children_of, trunk_chain

ROTATION_ORDER = "ZXY"
_METRES = {"m": 1.0, "mm": 0.001}  # of a skeleton's unit
_FILE_UNITS = {"cm": 100.0, "m": 1.0}
# A leaf bone has no child to end at: a hand or toe is half as long as the bone before it, the skull reaches
# half as far again as neck to skull.
_TIP_SHARE = 0.5
_HEAD_TIP_SHARE = 1.5


def file_scale(skeleton: Skeleton, unit: str) -> float:
    """Factor from the skeleton's unit to the file's, ``"cm"`` or ``"m"``.

    Raises:
        ValueError: If ``unit`` is neither.
    """
    if unit not in _FILE_UNITS:
        raise ValueError(f"`unit` must be 'cm' or 'm', got {unit!r}.")
    return _METRES[skeleton.unit] * _FILE_UNITS[unit]


def write_bvh(fit: RotationFit, path: Path, *, unit: str = "cm") -> None:
    """Write ``fit`` to ``path``, positions in ``unit`` ("cm" or "m").

    Raises:
        ValueError: If ``unit`` is unknown.
    """
    scale = file_scale(fit.skeleton, unit)
    lines = ["HIERARCHY", *_hierarchy(fit, scale), "MOTION", *_motion(fit, scale)]
    with replaced_on_success(path) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="ascii")


def depth_first(skeleton: Skeleton) -> list[int]:
    """Joint indices in the order in which a BVH file names them."""
    order, stack = [], [0]
    while stack:
        joint = stack.pop()
        order.append(joint)
        stack.extend(reversed(children_of(joint, skeleton)))
    return order


def _hierarchy(fit: RotationFit, scale: float) -> Iterator[str]:
    offsets = fit.offsets.numpy() * scale
    rotations = " ".join(f"{axis}rotation" for axis in ROTATION_ORDER)
    open_joints: list[int] = []
    for joint in depth_first(fit.skeleton):
        parent = fit.skeleton.parents[joint]
        while open_joints and open_joints[-1] != parent:
            open_joints.pop()
            yield "\t" * len(open_joints) + "}"
        indent = "\t" * len(open_joints)
        yield f"{indent}{'JOINT' if open_joints else 'ROOT'} {fit.skeleton.joint_names[joint]}"
        yield f"{indent}{{"
        yield f"{indent}\tOFFSET {_numbers(offsets[joint])}"
        root_channels = "" if open_joints else "Xposition Yposition Zposition "
        yield f"{indent}\tCHANNELS {3 if open_joints else 6} {root_channels}{rotations}"
        if not children_of(joint, fit.skeleton):
            tip = _numbers(bone_tip(joint, fit) * scale)
            yield from (f"{indent}\tEnd Site", f"{indent}\t{{", f"{indent}\t\tOFFSET {tip}", f"{indent}\t}}")
        open_joints.append(joint)
    for depth in reversed(range(len(open_joints))):
        yield "\t" * depth + "}"


def bone_tip(joint: int, fit: RotationFit) -> np.ndarray:
    """End of a leaf bone relative to its joint: skull up, toes level, hand along the lower arm."""
    bone = fit.offsets[joint].numpy()
    length = float(np.linalg.norm(bone))
    if joint in trunk_chain(fit.skeleton):
        return np.array([0.0, _HEAD_TIP_SHARE * length, 0.0])
    if joint in fit.skeleton.foot_joints:
        return np.array([0.0, 0.0, _TIP_SHARE * length])
    return _TIP_SHARE * bone


def _motion(fit: RotationFit, scale: float) -> Iterator[str]:
    order = depth_first(fit.skeleton)
    matrices = quat_to_matrix(fit.local_rotations[:, order]).numpy()
    angles = np.degrees(continuous_euler(matrices, ROTATION_ORDER))
    root = fit.root_positions.numpy() * scale
    rows = np.concatenate([root, angles.reshape(len(root), -1)], axis=1)
    yield f"Frames: {len(rows)}"
    yield f"Frame Time: {1 / fit.skeleton.fps:.8f}"
    yield from map(_numbers, rows)


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in values + 0.0)
