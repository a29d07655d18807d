"""Curves over time: how high the joints are, and how far controlled joints are from their targets."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from controlmm.viewer import palette
from controlmm.viewer.obstacles import clearance_over_time
from controlmm.viewer.scene import Scene
from controlmm.viewer.target_style import is_dense, target_color, target_marker, traced_joints

_LEGEND_COLUMNS = 3
_LEGEND_ROW = 0.14  # of the height of the curves


def draw_heights(axes: Axes, scene: Scene, *, has_time_label: bool) -> None:
    """Draw the height of pelvis, feet and controlled joints in metres, with the heights asked for."""
    seconds = np.arange(scene.num_frames) / scene.fps
    axes.plot(seconds, scene.joints[:, 0, 1], color=palette.PATH, linewidth=2.2, label="pelvis")
    for side, pair, color in (
        ("left foot", scene.skeleton.left_foot, palette.LEFT),
        ("right foot", scene.skeleton.right_foot, palette.RIGHT),
    ):
        axes.plot(seconds, scene.joints[:, pair, 1].min(1), color=color, linewidth=1.3, label=side)
    for joint in traced_joints(scene):
        if joint != 0:
            axes.plot(
                seconds, scene.joints[:, joint, 1], color=target_color(scene, joint), linewidth=1.8,
                label=_label(scene, joint),
            )  # fmt: skip
        asked = scene.is_asked[:, joint, 1]
        axes.plot(seconds[asked], scene.targets[asked, joint, 1], **target_marker(scene, joint, scale=0.8))
    axes.set_ylim(min(-0.05, float(scene.joints[..., 1].min())), None)
    _finish(axes, scene, title="height (m)", has_time_label=has_time_label)


def draw_distances(axes: Axes, scene: Scene, *, has_time_label: bool) -> None:
    """Draw the distances to the targets in cm: each controlled joint's, or mean and largest of a pose."""
    seconds = np.arange(scene.num_frames) / scene.fps
    distances = np.where(scene.is_controlled, 100 * scene.distances, np.nan)
    for joint in traced_joints(scene):
        marker = "" if is_dense(scene, joint) else "D"
        axes.plot(
            seconds, distances[:, joint], color=target_color(scene, joint), linewidth=1.5, marker=marker,
            markersize=4.0, label=_label(scene, joint),
        )  # fmt: skip
    if not traced_joints(scene):
        asked = scene.is_controlled.any(1)
        axes.plot(
            seconds[asked], np.nanmax(distances[asked], axis=1), "^", color=palette.FAINT, label="largest"
        )
        axes.plot(seconds[asked], np.nanmean(distances[asked], axis=1), "D", color=palette.INK, label="mean")
    axes.set_ylim(0, max(1e-3, 1.08 * float(np.nanmax(distances))))
    _finish(axes, scene, title="distance to target (cm)", has_time_label=has_time_label)


def draw_clearance(axes: Axes, scene: Scene, *, has_time_label: bool) -> None:
    """Draw the room in cm between the obstacles and the nearest joint that avoids them; below 0: inside."""
    room = clearance_over_time(scene)
    if room is None:
        return
    seconds = np.arange(scene.num_frames) / scene.fps
    axes.plot(seconds, 100 * room, color=palette.OBSTACLE, linewidth=1.6, label="nearest point")
    axes.axhline(0.0, color=palette.RIGHT, linewidth=1.0, linestyle="--")
    axes.set_ylim(min(-5.0, 100 * float(room.min()) - 2), max(20.0, 100 * float(np.minimum(room, 0.6).max())))
    _finish(axes, scene, title="room to obstacles (cm)", has_time_label=has_time_label)


def _label(scene: Scene, joint: int) -> str:
    return scene.skeleton.joint_names[joint].replace("_", " ")


def _finish(axes: Axes, scene: Scene, *, title: str, has_time_label: bool) -> None:
    end = max(scene.num_frames - 1, 1) / scene.fps
    axes.set_xlim(-0.01 * end, 1.01 * end)
    axes.grid(color=palette.GRID, linewidth=0.8)
    axes.tick_params(labelsize=9, colors=palette.PATH, length=0)
    axes.spines[:].set_color(palette.GRID)
    axes.set_title(title, fontsize=11, color=palette.PATH, loc="left")
    if has_time_label:
        axes.set_xlabel("time (s)", fontsize=9, color=palette.PATH)
    names = len(axes.get_legend_handles_labels()[1])
    low, high = axes.get_ylim()  # room for the names above the curves, which fill the rest of the panel
    axes.set_ylim(low, high + _LEGEND_ROW * -(-names // _LEGEND_COLUMNS) * (high - low))
    axes.legend(
        fontsize=8, frameon=False, ncols=_LEGEND_COLUMNS, loc="upper right", borderaxespad=0.2,
        labelcolor=palette.INK, handlelength=1.2,
    )  # fmt: skip
