"""A simple body: every bone a long eight-sided solid, as animation programs draw bones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from controlmm.io.bvh_writer import bone_tip
from controlmm.motion.body_parts import body_parts
from controlmm.motion.rotation_fit import RotationFit
from controlmm.motion.skeleton import Skeleton
from controlmm.motion.t_pose import children_of

Color = tuple[float, float, float]

# linear RGB of the blue, orange and grey that pictures have
_COLORS: dict[str, Color] = {
    "left": (0.021, 0.188, 0.578), "right": (0.745, 0.098, 0.024), "trunk": (0.115, 0.133, 0.168)
}  # fmt: skip
_WAIST = 0.15  # of a bone's length from its joint, where it is thickest
_WIDTH = 0.10  # of its length, from the axis
_WIDEST = 0.05  # metres
_FACES = np.array(  # corners: joint, tip, four around the waist
    [[0, 3, 2], [0, 4, 3], [0, 5, 4], [0, 2, 5], [1, 2, 3], [1, 3, 4], [1, 4, 5], [1, 5, 2]]
)


@dataclass(frozen=True, eq=False)
class BoneMesh:
    """Triangles of a body at rest.

    Attributes:
        positions: (N, 3) corners in metres; no two triangles share one, so that edges stay sharp.
        normals: (N, 3) of their triangles.
        joints: (N,) the joint that a corner follows.
        faces: By name of the side: colour and (F, 3) corners, counter-clockwise from outside.
    """

    positions: Float[ndarray, "N 3"]
    normals: Float[ndarray, "N 3"]
    joints: Int[ndarray, "N"]
    faces: dict[str, tuple[Color, Int[ndarray, "F 3"]]]


def bone_mesh(fit: RotationFit, rest: Float[ndarray, "J 3"]) -> BoneMesh:
    """The body of a fitted skeleton whose joints rest at ``rest``, metres."""
    scale = 0.001 if fit.skeleton.unit == "mm" else 1.0
    positions, joints, sides = [], [], []
    for joint in range(fit.skeleton.num_joints):
        ends = [rest[child] for child in children_of(joint, fit.skeleton)]
        for end in ends or [rest[joint] + bone_tip(joint, fit) * scale]:
            corners = _bone(rest[joint], end)[_FACES].reshape(-1, 3)
            positions.append(corners)
            joints += [joint] * len(corners)
            sides += [_side(joint, fit.skeleton)] * len(_FACES)
    corners = np.concatenate(positions)
    triangles = corners.reshape(-1, 3, 3)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    indices = np.arange(len(corners)).reshape(-1, 3)
    return BoneMesh(
        corners.astype(np.float32),
        normals.repeat(3, axis=0).astype(np.float32),
        np.array(joints),
        {name: (color, indices[np.array(sides) == name]) for name, color in _COLORS.items()},
    )


def _bone(start: Float[ndarray, "3"], end: Float[ndarray, "3"]) -> Float[ndarray, "6 3"]:
    """Corners of a bone: its ends and four around its waist."""
    axis = end - start
    length = max(float(np.linalg.norm(axis)), 1e-6)
    along = axis / length
    across = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    across /= np.linalg.norm(across)
    third = np.cross(along, across)
    width = min(_WIDTH * length, _WIDEST)
    waist = start + _WAIST * axis
    ring = [waist + width * side for side in (across, third, -across, -third)]
    return np.stack([start, start + max(length, 1e-3) * along, *ring])


def _side(joint: int, skeleton: Skeleton) -> str:
    """Which side the bones that start at a joint are on."""
    part = next(part for part in body_parts(skeleton) if joint in part.joints)
    return next((side for side in ("left", "right") if part.name.startswith(side)), "trunk")
