"""The figure at evenly spaced times, side by side."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from controlmm.viewer import palette
from controlmm.viewer.camera import Camera
from controlmm.viewer.scene import Scene
from controlmm.viewer.stick_figure import StickFigure
from controlmm.viewer.target_style import target_color, target_marker, traced_joints

_TAIL_SECONDS = 0.2  # of the trail that a controlled joint draws behind itself
_GAP = 0.12  # metres between neighbouring figures


def shown_frames(scene: Scene, count: int) -> list[int]:
    """Evenly spaced frames, first to last; few control keyframes take the place of their neighbours."""
    even = np.unique(np.linspace(0, scene.num_frames - 1, count).round().astype(int))
    keys = np.flatnonzero(scene.is_controlled.any(1))
    if len(keys) <= len(even):
        for key in keys:
            even[np.abs(even - key).argmin()] = key
    return [int(frame) for frame in np.unique(even)]


def draw_pose_strip(axes: Axes, scene: Scene, *, frames: int) -> Callable[[float], float]:
    """Draw the poses from left to right on one ground line, the time in seconds under each.

    Returns where a frame stands across the axes.
    """
    camera = Camera(elevation=10.0)
    shown = shown_frames(scene, frames)
    centered = scene.joints[shown] - scene.joints[shown][:, :1] * np.array([1.0, 0.0, 1.0])
    points = camera.project(centered)
    top = max(1.75, float(points[..., 1].max()) + 0.2)
    bottom = min(-0.12, float(points[..., 1].min()) - 0.05)
    panel = axes.get_window_extent()
    room = (top - bottom + 0.2) * panel.width / panel.height / len(shown)
    spacing = max(room, float(np.ptp(points[..., 0], axis=1).max()) + _GAP)
    for slot, frame in enumerate(shown):
        _draw_pose(axes, scene, frame, camera=camera, shift=slot * spacing)
        axes.text(
            slot * spacing, bottom - 0.04, f"{frame / scene.fps:.2f} s", ha="center", va="top", fontsize=11,
            color=palette.INK,
        )  # fmt: skip
    axes.axhline(0.0, color=palette.GRID, linewidth=1.2, zorder=0)
    axes.set_xlim(-0.5 * spacing, (len(shown) - 0.5) * spacing)
    axes.set_ylim(bottom - 0.2, top)
    axes.set_aspect("equal")
    axes.axis("off")
    ways = spacing * np.arange(len(shown))
    return lambda frame: float(np.interp(frame, shown, ways)) if len(shown) > 1 else 0.0


def _draw_pose(axes: Axes, scene: Scene, frame: int, *, camera: Camera, shift: float) -> None:
    offset = np.array([shift, 0.0])
    center = scene.joints[frame, 0] * np.array([1.0, 0.0, 1.0])
    axes.add_patch(Ellipse((shift, 0.0), 0.62, 0.13, facecolor=palette.GRID, edgecolor="none", zorder=1))
    StickFigure(axes, scene.skeleton, width=3.6).set_pose(
        scene.joints[frame] - center, camera, shift=(shift, 0.0)
    )
    start = max(0, frame - round(_TAIL_SECONDS * scene.fps))
    for joint in traced_joints(scene):
        tail = camera.project(scene.joints[start : frame + 1, joint] - center) + offset
        axes.plot(*tail.T, color=target_color(scene, joint), linewidth=1.6, alpha=0.7, zorder=2.5)
    for joint in np.flatnonzero(scene.is_controlled[frame]).tolist():
        target = camera.project(scene.targets[frame, joint] - center) + offset
        axes.plot(*target, zorder=6, **target_marker(scene, joint, is_single=True))
