"""A motion among obstacles, from above and from the side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from controlmm.io.atomic import replaced_on_success
from controlmm.motion.motion import Motion
from controlmm.viewer import palette
from controlmm.viewer.camera import Camera
from controlmm.viewer.obstacles import draw_obstacles, obstacle_points
from controlmm.viewer.scene import Scene, scene_of
from controlmm.viewer.scene_panels import draw_top_view
from controlmm.viewer.stick_figure import StickFigure
from controlmm.viewer.target_style import target_marker

_SIZE = (11.0, 5.0)  # inches
_FIGURES = 9
_FROM_RIGHT = Camera(azimuth=-90.0, elevation=0.0)  # +Z runs to the right, heights are true


def save_scene_views(motion: Motion, path: str | Path, *, title: str | None = None, dpi: int = 90) -> Path:
    """Write a picture of a motion with its obstacles and targets, from above and from its right side.

    Obstacles and targets are those in ``motion.extra``. Returns the path.
    """
    path = Path(path)
    scene = scene_of(motion)
    figure = Figure(figsize=_SIZE, facecolor=palette.PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    words = motion.text if title is None else title
    figure.suptitle(words, fontsize=13, fontweight="bold", color=palette.INK, parse_math=False)
    above, side = figure.subplots(1, 2, width_ratios=(1.0, 1.35))
    draw_top_view(above, scene)
    _draw_side_view(side, scene)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced_on_success(path) as partial:
        figure.savefig(partial, dpi=dpi, format="png")
    return path


def _draw_side_view(axes: Axes, scene: Scene) -> None:
    """Heights over the way ahead (z): figures, obstacles, the way of the pelvis and the targets."""
    project = _FROM_RIGHT.project
    draw_obstacles(axes, scene, project)
    frames = np.linspace(0, scene.num_frames - 1, _FIGURES).round().astype(int)
    for frame, opacity in zip(frames, np.linspace(0.3, 1.0, len(frames)), strict=True):
        figure = StickFigure(axes, scene.skeleton, width=2.4, opacity=float(opacity), zorder=3 + 0.01 * frame)
        figure.set_pose(scene.joints[frame], _FROM_RIGHT)
    axes.plot(*project(scene.joints[:, 0]).T, color=palette.PATH, linewidth=1.6, zorder=9)
    for joint in scene.controlled_joints():
        asked = scene.targets[scene.is_controlled[:, joint], joint]
        axes.plot(*project(asked).T, zorder=10, **target_marker(scene, joint))
    axes.axhline(0.0, color=palette.FAINT, linewidth=1.0, zorder=0)
    points = project(np.concatenate([scene.joints.reshape(-1, 3), obstacle_points(scene)]))
    ahead = project(scene.joints.reshape(-1, 3))[:, 0]
    axes.set_xlim(ahead.min() - 0.4, ahead.max() + 0.4)
    axes.set_ylim(-0.1, min(float(points[:, 1].max()), 3.0) + 0.1)
    axes.set_aspect("equal")
    axes.grid(color=palette.GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9, colors=palette.PATH, length=0)
    axes.spines[:].set_color(palette.GRID)
    axes.set_xlabel("z (m)    front →", fontsize=9, color=palette.PATH)
    axes.set_ylabel("height (m)", fontsize=9, color=palette.PATH)
    axes.set_title("from the right side", fontsize=11, color=palette.PATH, loc="left")
