"""A stick figure as matplotlib artists whose pose can be changed without drawing them anew."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Circle, Polygon
from numpy import ndarray

from controlmm.motion.skeleton import Skeleton
from controlmm.motion.t_pose import trunk_chain
from controlmm.viewer import palette
from controlmm.viewer.camera import Camera

_HEAD_RADIUS = 0.085  # metres
_HEAD_LIFT = 0.06  # metres from the joint at the base of the skull to its middle


def joint_colors(skeleton: Skeleton) -> list[str]:
    """Colour of the bone that ends at each joint: left, right or trunk."""
    right_hip, left_hip, right_shoulder, left_shoulder = skeleton.facing
    colors = [palette.TRUNK] * skeleton.num_joints
    for chain in skeleton.chains:
        sided = chain[1:]
        if left_hip in sided or left_shoulder in sided:
            color = palette.LEFT
        elif right_hip in sided or right_shoulder in sided:
            color = palette.RIGHT
        else:
            continue
        for joint in sided:
            colors[joint] = color
    return colors


class StickFigure:
    """One figure in ``axes``; call :meth:`set_pose` before the first drawing.

    Example:
        >>> figure = StickFigure(axes, HUMANML3D, width=3.0)
        >>> figure.set_pose(joints, Camera())

    Args:
        axes: Axes whose data unit is the metre, with equal scales.
        skeleton: Hierarchy of the joints.
        width: Width of the bones in points.
        opacity: Strength of the colours, 0 to 1; they are mixed with the paper, not see-through.
        zorder: Where the figure lies among the other artists.
    """

    def __init__(
        self, axes: Axes, skeleton: Skeleton, *, width: float, opacity: float = 1.0, zorder: float = 3
    ) -> None:
        right_hip, left_hip, right_shoulder, left_shoulder = skeleton.facing
        self._torso_joints = [left_shoulder, right_shoulder, right_hip, left_hip]
        self._child = np.arange(1, skeleton.num_joints)
        self._parent = np.array(skeleton.parents[1:])
        self._neck, self._head = trunk_chain(skeleton)[-2:]
        self._colors = np.array([palette.paler(color, opacity) for color in joint_colors(skeleton)[1:]])
        self._torso = Polygon(
            np.zeros((4, 2)),
            closed=True,
            facecolor=palette.paler(palette.TORSO, 0.55 * opacity),
            edgecolor="none",
            zorder=zorder,
        )
        self._bones = LineCollection([], linewidths=width, capstyle="round", zorder=zorder + 0.1)
        self._skull = Circle(
            (0, 0), _HEAD_RADIUS, facecolor=palette.PAPER, edgecolor=palette.paler(palette.TRUNK, opacity),
            linewidth=0.6 * width, zorder=zorder + 0.2,
        )  # fmt: skip
        axes.add_patch(self._torso)
        axes.add_collection(self._bones, autolim=False)
        axes.add_patch(self._skull)

    def set_pose(
        self, joints: Float[ndarray, "J 3"], camera: Camera, *, shift: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Show ``joints`` (metres, world) as ``camera`` sees them, moved by ``shift`` metres."""
        points = camera.project(joints) + np.array(shift)
        depth = camera.depth(joints)
        order = np.argsort(depth[self._child] + depth[self._parent])  # far bones first
        self._bones.set_segments(list(np.stack([points[self._parent], points[self._child]], axis=1)[order]))
        self._bones.set_color(list(self._colors[order]))
        self._torso.set_xy(points[self._torso_joints])
        neck, head = joints[self._neck], joints[self._head]
        rise = (head - neck) / max(float(np.linalg.norm(head - neck)), 1e-9) * 0.4 + np.array([0.0, 0.6, 0.0])
        center = camera.project(head + _HEAD_LIFT * rise) + np.array(shift)
        self._skull.set_center((float(center[0]), float(center[1])))
