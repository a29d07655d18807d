"""The whole motion in place: a three-quarter view with figures along the way, and a map from above."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy import ndarray

from controlmm.viewer import palette
from controlmm.viewer.camera import Camera
from controlmm.viewer.ground import draw_grid, ground_box
from controlmm.viewer.obstacles import draw_obstacles, obstacle_points
from controlmm.viewer.scene import Scene
from controlmm.viewer.stick_figure import StickFigure
from controlmm.viewer.target_style import target_color, target_marker, traced_joints

_FIGURE_EVERY = 0.5  # metres that the joints move on average between two figures of the overview
_FIGURES = (3, 9)  # fewest and most
_FACING_EVERY = 0.4  # metres of way between two ticks that show the facing
_OBSTACLE_REACH = 1.0  # metres around the way within which obstacles widen the picture
_SMALLEST_MAP = 2.0  # metres across, so that standing still looks like it


def draw_overview(axes: Axes, scene: Scene) -> None:
    """Draw figures along the way on a ground grid, older ones paler, with trails and all targets."""
    camera = Camera(elevation=24.0)
    box = ground_box(scene.joints, margin=0.1)
    draw_grid(axes, camera, box)
    axes.plot(*camera.project(scene.joints[:, 0] * [1, 0, 1]).T, color=palette.FAINT, linewidth=1.4, zorder=1)
    draw_obstacles(axes, scene, camera.project)
    frames = _frames_along(_mean_way(scene), every=_FIGURE_EVERY)
    nearness = camera.depth(scene.joints[frames, 0]).argsort().argsort()
    opacities = np.linspace(1.0, 0.22, len(frames))[::-1]
    for frame, opacity, rank in zip(frames, opacities, nearness, strict=True):
        figure = StickFigure(
            axes, scene.skeleton, width=3.0, opacity=float(opacity), zorder=3 + 0.5 * float(rank)
        )
        figure.set_pose(scene.joints[frame], camera)
    _draw_controls(axes, scene, camera.project(scene.joints), camera.project(scene.targets))
    corners = np.array([[x, 0.0, z] for x in box[:2] for z in box[2:]])
    _fit(
        axes,
        camera.project(np.concatenate([scene.joints.reshape(-1, 3), _asked(scene), corners, _seen(scene)])),
        margin=0.12,
    )
    axes.axis("off")
    axes.set_title("in place (grid 0.5 m)", fontsize=11, color=palette.PATH, loc="left")


def draw_top_view(axes: Axes, scene: Scene) -> None:
    """Draw the ways from above: +Z, the first facing, is up, and so the figure's left (+X) is on the left."""
    root = scene.joints[:, 0][:, [0, 2]]
    draw_obstacles(axes, scene, lambda points: points[..., [0, 2]])
    axes.plot(*root.T, color=palette.PATH, linewidth=2.2, zorder=2)
    _draw_facing(axes, scene)
    _draw_controls(axes, scene, scene.joints[..., [0, 2]], scene.targets[..., [0, 2]])
    axes.plot(*root[0], marker="o", markersize=9, color=palette.PAPER, markeredgecolor=palette.INK, zorder=11)
    axes.plot(*root[-1], marker="s", markersize=8, color=palette.INK, zorder=11)
    ways = scene.joints[:, [0, *traced_joints(scene)]].reshape(-1, 3)
    shown = np.concatenate([ways, _asked(scene), _seen(scene)])
    _fit(axes, shown[:, [0, 2]], margin=0.3, smallest=_SMALLEST_MAP)
    axes.invert_xaxis()
    axes.grid(color=palette.GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(nbins=6, steps=[1, 2, 5, 10]))
    axes.tick_params(labelsize=9, colors=palette.PATH, length=0)
    axes.spines[:].set_color(palette.GRID)
    axes.set_xlabel("← left    x (m)", fontsize=9, color=palette.PATH)
    axes.set_ylabel("z (m)    front →", fontsize=9, color=palette.PATH)
    axes.set_title("from above   ○ start   ■ end   - facing", fontsize=11, color=palette.PATH, loc="left")


def _draw_controls(
    axes: Axes, scene: Scene, ways: Float[ndarray, "T J 2"], targets: Float[ndarray, "T J 2"]
) -> None:
    for joint in traced_joints(scene):
        axes.plot(*ways[:, joint].T, color=target_color(scene, joint), linewidth=1.8, alpha=0.85, zorder=9)
    for joint in scene.controlled_joints():
        asked = targets[scene.is_controlled[:, joint], joint]
        axes.plot(*asked.T, zorder=10, **target_marker(scene, joint))


def _draw_facing(axes: Axes, scene: Scene) -> None:
    """Short ticks along the way in the direction that the hips face."""
    right_hip, left_hip, _, _ = scene.skeleton.facing
    frames = _frames_along(_way(scene.joints[:, 0] * [1, 0, 1]), every=_FACING_EVERY)
    across = scene.joints[frames, left_hip] - scene.joints[frames, right_hip]
    front = np.stack([-across[:, 2], across[:, 0]], axis=-1)  # (x, z) of `across` turned to the front about Y
    front /= np.maximum(np.linalg.norm(front, axis=-1, keepdims=True), 1e-9)
    start = scene.joints[frames, 0][:, [0, 2]]
    for a, b in zip(start, start + 0.2 * front, strict=True):
        axes.plot(*np.stack([a, b]).T, color=palette.FAINT, linewidth=2.0, solid_capstyle="round", zorder=1.5)


def _way(points: Float[ndarray, "T 3"]) -> Float[ndarray, "T"]:
    """Length of the way to each frame in metres."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    return np.concatenate([[0.0], steps.cumsum()])


def _mean_way(scene: Scene) -> Float[ndarray, "T"]:
    """Way to each frame in metres, the mean over the joints, so that moves on the spot count too."""
    result: ndarray = np.mean(
        [_way(scene.joints[:, joint]) for joint in range(scene.skeleton.num_joints)], axis=0
    )
    return result


def _frames_along(way: Float[ndarray, "T"], *, every: float) -> list[int]:
    """First and last frame, and between them as many, evenly along the way, as it is long."""
    count = int(np.clip(way[-1] / every + 1, *_FIGURES))
    frames = np.searchsorted(way, np.linspace(0, way[-1], count), side="left")
    frames[-1] = len(way) - 1
    return [int(frame) for frame in np.unique(frames)]


def _seen(scene: Scene) -> Float[ndarray, "N 3"]:
    """Points of obstacles near the way; of large and far ones only what is near is shown."""
    points, ways = obstacle_points(scene), scene.joints.reshape(-1, 3)
    low, high = ways.min(0) - _OBSTACLE_REACH, ways.max(0) + _OBSTACLE_REACH
    near: ndarray = points[((points >= low) & (points <= high)).all(1)]
    return near


def _asked(scene: Scene) -> Float[ndarray, "N 3"]:
    result: ndarray = scene.targets[scene.is_controlled]
    return result


def _fit(axes: Axes, points: Float[ndarray, "N 2"], *, margin: float, smallest: float = 0.0) -> None:
    """Equal scales and limits around ``points`` that fill the panel's own shape."""
    low, high = points.min(0) - margin, points.max(0) + margin
    panel = axes.get_window_extent()
    ratio = panel.width / panel.height
    middle, size = (low + high) / 2, np.maximum(high - low, smallest)
    width = max(size[0], size[1] * ratio)
    axes.set_xlim(middle[0] - width / 2, middle[0] + width / 2)
    axes.set_ylim(middle[1] - width / ratio / 2, middle[1] + width / ratio / 2)
    axes.set_aspect("equal")
