"""The frames of a moving figure: artists are made once and only moved, which is what makes it fast."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy import ndarray

from controlmm.viewer import palette
from controlmm.viewer.camera import Camera
from controlmm.viewer.ground import draw_grid, ground_box
from controlmm.viewer.obstacles import draw_obstacles
from controlmm.viewer.scene import Scene
from controlmm.viewer.stick_figure import StickFigure
from controlmm.viewer.target_style import target_color, target_marker, traced_joints

_DPI = 100
_FOLLOW_METRES = 2.6  # picture height that the following camera shows
_CAPTION = 0.11  # share of the picture above the scene


class MovingPicture:
    """Draws a scene frame by frame.

    Example:
        >>> picture = MovingPicture(scene_of(motion), title="a person walks", size=(640, 520))
        >>> for frame in picture.frames():
        ...     frame.shape  # (520, 640, 3)

    Args:
        scene: What to show.
        title: One line above the picture, cut where it does not fit.
        size: Width and height in pixels, both even, 160 to 2048.
        follow: Keep the pelvis in the middle instead of showing the whole way.

    Raises:
        ValueError: If ``size`` is odd or out of range.
    """

    def __init__(self, scene: Scene, *, title: str, size: tuple[int, int], follow: bool = False) -> None:
        if any(side % 2 or not 160 <= side <= 2048 for side in size):
            raise ValueError(f"`size` must be two even numbers in 160..2048, got {tuple(size)}.")
        self._scene, self._follow, self._camera = scene, follow, Camera(elevation=18.0)
        self._figure = Figure(figsize=(size[0] / _DPI, size[1] / _DPI), dpi=_DPI, facecolor=palette.PAPER)
        self._canvas = FigureCanvasAgg(self._figure)
        self._axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0 - _CAPTION))
        self._axes.axis("off")
        self._axes.set_aspect("equal", adjustable="box")
        self._ways = self._camera.project(scene.joints)
        self._frame_view(size[0] / (size[1] * (1.0 - _CAPTION)))
        self._write_title(title, size[0])
        _draw_still_life(self._axes, scene, self._camera)
        self._body = StickFigure(self._axes, scene.skeleton, width=3.0 + size[1] / 260, zorder=4)
        self._trails = {joint: self._line(target_color(scene, joint), 2.0) for joint in traced_joints(scene)}
        self._trails.setdefault(0, self._line(palette.FAINT, 1.2))
        self._now = {joint: self._marker(joint) for joint in scene.controlled_joints()}
        self._bar = Line2D([0, 0], [0, 0], color=palette.INK, linewidth=4)
        self._figure.add_artist(self._bar)
        self._clock = self._figure.text(
            0.97, 0.955, "", fontsize=10, color=palette.PATH, ha="right", va="center"
        )

    def frames(self) -> Iterator[UInt8[ndarray, "H W 3"]]:
        """The pictures in order, 8-bit RGB, one for each frame of the motion."""
        for frame in range(self._scene.num_frames):
            self._show(frame)
            self._canvas.draw()
            yield np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _show(self, frame: int) -> None:
        scene = self._scene
        self._body.set_pose(scene.joints[frame], self._camera)
        for joint, line in self._trails.items():
            line.set_data(*self._ways[: frame + 1, joint].T)
        for joint, marker in self._now.items():
            marker.set_visible(bool(scene.is_controlled[frame, joint]))
            marker.set_data(*self._camera.project(scene.targets[frame : frame + 1, joint]).T)
        if self._follow:
            self._look_at(self._camera.project(scene.joints[frame, 0] * [1.0, 0.0, 1.0] + [0.0, 0.9, 0.0]))
        self._bar.set_data([0, (frame + 1) / scene.num_frames], [0.003, 0.003])
        self._clock.set_text(f"{frame / scene.fps:5.2f} s")

    def _frame_view(self, ratio: float) -> None:
        """Limits that show the whole way, or a constant size to follow with; ``ratio``: width to height."""
        scene = self._scene
        points = np.concatenate([scene.joints.reshape(-1, 3), scene.targets[scene.is_controlled]])
        seen = self._camera.project(np.concatenate([points, points * [1, 0, 1]]))
        low, high = seen.min(0) - 0.25, seen.max(0) + 0.25
        height = max(high[1] - low[1], (high[0] - low[0]) / ratio)
        self._half = np.array([ratio, 1.0]) * (_FOLLOW_METRES if self._follow else height) / 2
        self._look_at((low + high) / 2)

    def _look_at(self, middle: Float[ndarray, "2"]) -> None:
        (left, bottom), (right, top) = middle - self._half, middle + self._half
        self._axes.set_xlim(left, right)
        self._axes.set_ylim(bottom, top)

    def _write_title(self, title: str, width: int) -> None:
        words = " ".join(title.split())
        room = max(10, width // 9)
        line = words if len(words) <= room else words[: room - 3].rstrip() + "..."
        self._figure.text(
            0.03,
            0.955,
            line,
            fontsize=11,
            fontweight="bold",
            color=palette.INK,
            va="center",
            parse_math=False,
        )

    def _line(self, color: str, width: float) -> Line2D:
        return self._axes.plot([], [], color=color, linewidth=width, zorder=3, solid_capstyle="round")[0]

    def _marker(self, joint: int) -> Line2D:
        style = target_marker(self._scene, joint, scale=1.3, is_single=True)
        return self._axes.plot([], [], zorder=7, **style)[0]


def _draw_still_life(axes: Axes, scene: Scene, camera: Camera) -> None:
    """The grid and all targets, pale: those of the moment are drawn over them."""
    draw_grid(axes, camera, ground_box(scene.joints, margin=0.4))
    draw_obstacles(axes, scene, camera.project)
    for joint in scene.controlled_joints():
        asked = camera.project(scene.targets[scene.is_controlled[:, joint], joint])
        axes.plot(*asked.T, zorder=2, **(target_marker(scene, joint) | {"alpha": 0.3}))
