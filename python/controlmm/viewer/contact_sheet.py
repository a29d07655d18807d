"""A motion on one page: poses in time, the scene from the side and from above, heights and control errors."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from controlmm.io.atomic import replaced_on_success
from controlmm.motion.motion import Motion
from controlmm.viewer import palette
from controlmm.viewer.pose_strip import draw_pose_strip
from controlmm.viewer.scene import Scene, scene_of
from controlmm.viewer.scene_panels import draw_overview, draw_top_view
from controlmm.viewer.time_panels import draw_clearance, draw_distances, draw_heights
from controlmm.viewer.timeline_tracks import draw_timeline_tracks, track_names

_SIZE = (15.0, 9.2)  # inches
_TITLE_CHARACTERS = 100


def contact_sheet(
    motion: Motion, *, targets: Any = None, mask: Any = None, title: str | None = None, frames: int = 10
) -> Figure:
    """Draw a motion on one page.

    Args:
        motion: The motion; KIT-ML millimetres are shown in metres.
        targets: (T, J, 3) control targets in the skeleton's unit; ``None`` takes ``motion.extra["targets"]``.
        mask: (T, J, 3) bool, the coordinates asked for; ``None`` takes ``motion.extra["mask"]``.
        title: Headline; ``None`` takes the motion's text.
        frames: Poses to show, 2 to 24, evenly spaced; fewer when the motion is shorter. Few control keyframes
            are shown in place of the nearest pose.

    Returns:
        A matplotlib figure on the Agg canvas, independent of pyplot.

    Raises:
        ValueError: If ``frames`` is out of range or targets and mask do not fit the motion.
    """
    if not 2 <= frames <= 24:
        raise ValueError(f"`frames` must be in 2..24, got {frames}.")
    scene = scene_of(motion, targets=targets, mask=mask)
    figure = Figure(figsize=_SIZE, facecolor=palette.PAPER)
    FigureCanvasAgg(figure)
    _draw_title(figure, scene, title if title is not None else motion.text)
    tracks = 0.09 * len(track_names(scene))
    rows = figure.add_gridspec(
        3, 1, left=0.035, right=0.985, top=0.90, bottom=0.06, height_ratios=[max(tracks, 1e-3), 1.0, 1.15],
        hspace=0.1 if tracks else 0.065,
    )  # fmt: skip
    place = draw_pose_strip(strip := figure.add_subplot(rows[1]), scene, frames=frames)
    if scene.timeline:
        draw_timeline_tracks(figure.add_subplot(rows[0], sharex=strip), scene, place)
    columns = rows[2].subgridspec(1, 3, width_ratios=[1.45, 1.0, 1.0], wspace=0.14)
    draw_overview(figure.add_subplot(columns[0]), scene)
    draw_top_view(figure.add_subplot(columns[1]), scene)
    curves = [draw_heights]
    if scene.control_error() is not None:
        curves.append(draw_distances)
    if scene.obstacles:
        curves.append(draw_clearance)
    stacked = columns[2].subgridspec(len(curves), 1, hspace=0.32 if len(curves) < 3 else 0.5)
    for row, draw in enumerate(curves):
        draw(figure.add_subplot(stacked[row]), scene, has_time_label=row == len(curves) - 1)
    return figure


def _draw_title(figure: Figure, scene: Scene, title: str) -> None:
    words = " ".join(title.split()) or "(no text)"
    lines = textwrap.wrap(words, _TITLE_CHARACTERS, max_lines=2, placeholder=" ...")
    figure.text(
        0.035, 0.952, "\n".join(lines), fontsize=17 if len(lines) == 1 else 13, fontweight="bold",
        color=palette.INK, va="center", parse_math=False, linespacing=1.25,
    )  # fmt: skip
    facts = [f"{scene.num_frames / scene.fps:.2f} s", f"{scene.num_frames} frames at {scene.fps:g} fps"]
    error = scene.control_error()
    if error is not None:
        count = int(scene.is_controlled.sum())
        facts.append(f"control error {100 * error:.2f} cm mean, {100 * scene.distances.max():.2f} cm max")
        facts.append(f"{count} target{'s' if count > 1 else ''} on {len(scene.controlled_joints())} joint(s)")
    figure.text(0.035, 0.922, "   ·   ".join(facts), fontsize=11.5, color=palette.PATH, va="top")
    for x, name, color in (
        (0.80, "left", palette.LEFT),
        (0.85, "right", palette.RIGHT),
        (0.905, "trunk", palette.TRUNK),
    ):
        figure.text(x, 0.922, f"● {name}", fontsize=11.5, color=color, va="top")


class PngFormat:
    """Writer of ``.png``: the contact sheet."""

    @staticmethod
    def save(
        motion: Motion,
        path: Path,
        *,
        targets: Any = None,
        mask: Any = None,
        title: str | None = None,
        frames: int = 10,
        dpi: int = 110,
    ) -> None:
        """Write :func:`contact_sheet` at ``dpi`` (20 to 400) dots an inch: 1650 x 1034 pixels at 110.

        Raises:
            ValueError: As :func:`contact_sheet`, or if ``dpi`` is out of range.
        """
        if not 20 <= dpi <= 400:
            raise ValueError(f"`dpi` must be in 20..400, got {dpi}.")
        figure = contact_sheet(motion, targets=targets, mask=mask, title=title, frames=frames)
        with replaced_on_success(path) as partial:
            figure.savefig(partial, dpi=dpi, facecolor=palette.PAPER)

    @staticmethod
    def load(path: Path) -> Motion:
        """A picture holds no motion: always raises ``ValueError``."""
        raise ValueError(
            f"{path}: a .png is a picture of a motion and cannot be loaded. Load the .npz or .bvh."
        )
