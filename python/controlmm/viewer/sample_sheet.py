"""What a network makes of a few recorded clips: the record above, its work below."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from controlmm.io.atomic import replaced_on_success
from controlmm.motion.motion import Motion
from controlmm.viewer import palette
from controlmm.viewer.pose_strip import draw_pose_strip
from controlmm.viewer.scene import scene_of

_WIDTH, _ROW_HEIGHT = 12.0, 2.1  # inches
_DPI = 80


def sample_sheet(pairs: Sequence[tuple[str, Motion, Motion]], *, title: str = "", frames: int = 10) -> Figure:
    """Draw pairs of motions, two strips of poses for each.

    Args:
        pairs: A caption, the recorded motion and the one that was made.
        title: Headline.
        frames: Poses in a strip.

    Returns:
        A matplotlib figure on the Agg canvas, independent of pyplot.

    Raises:
        ValueError: If there is no pair.
    """
    if not pairs:
        raise ValueError("`pairs` is empty, so there is nothing to draw.")
    rows = 2 * len(pairs)
    figure = Figure(figsize=(_WIDTH, _ROW_HEIGHT * rows + 0.5), facecolor=palette.PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=13, fontweight="bold", color=palette.INK, parse_math=False)
    for index, (caption, recorded, made) in enumerate(pairs):
        for row, (kind, motion) in enumerate((("recorded", recorded), ("made", made))):
            axes = figure.add_subplot(rows, 1, 2 * index + row + 1)
            draw_pose_strip(axes, scene_of(motion), frames=frames)
            label = f"{caption}\n{kind}" if row == 0 else kind
            axes.set_title(label, loc="left", fontsize=9, color=palette.INK, parse_math=False)
    return figure


def save_sample_sheet(pairs: Sequence[tuple[str, Motion, Motion]], path: Path, *, title: str = "") -> Path:
    """Write :func:`sample_sheet` as a picture; returns ``path``.

    Raises:
        ValueError: As :func:`sample_sheet`.
    """
    figure = sample_sheet(pairs, title=title)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced_on_success(path) as partial:
        figure.savefig(partial, dpi=_DPI)
    return path
