"""The tracks of a timeline: one row a body part, a bar for each prompt, above the poses of its time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes

from controlmm.viewer import palette
from controlmm.viewer.scene import Scene

_BAR = 0.78  # height of a bar in rows
_LETTERS = 150  # that fit across the picture


def track_names(scene: Scene) -> list[str]:
    """The parts of the timeline, each once, in the order of the entries."""
    return list(dict.fromkeys(entry.part for entry in scene.timeline))


def draw_timeline_tracks(axes: Axes, scene: Scene, place: Callable[[float], float]) -> None:
    """Draw the bars of all entries.

    Args:
        axes: Axes above the strip of poses, with the same limits across.
        scene: With a timeline.
        place: Where a frame stands across the strip of poses.
    """
    names = track_names(scene)
    colors = {name: palette.CONTROL[index % len(palette.CONTROL)] for index, name in enumerate(names)}
    for number, entry in enumerate(scene.timeline, start=1):
        row = names.index(entry.part)
        left, right = place(entry.start), place(entry.end)
        axes.barh(
            row, right - left, left=left, height=_BAR, color=palette.paler(colors[entry.part], 0.3),
            edgecolor=colors[entry.part], linewidth=1.2,
        )  # fmt: skip
        share = (right - left) / np.ptp(axes.get_xlim())
        words = _shortened(f"{number}. {entry.prompt}", most=int(_LETTERS * share))
        axes.text(left, row, f"  {words}", fontsize=9.5, va="center", color=palette.INK, parse_math=False)
    for row, name in enumerate(names):
        label = name.replace("_", " ")
        axes.text(0.0, row, label, fontsize=9.5, va="center", ha="left", transform=axes.get_yaxis_transform(),
                  color=colors[name])  # fmt: skip
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.axis("off")


def _shortened(words: str, *, most: int) -> str:
    return words if len(words) <= most else words[: max(1, most - 3)].rstrip() + "..."
