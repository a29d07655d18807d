"""Curves of a training run: one panel a metric, training and validation together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from controlmm.io.atomic import replaced_on_success
from controlmm.viewer import palette

_COLUMNS = 3
_PANEL = (4.6, 3.0)  # inches
_VALIDATION = "val_"
_STEP = "step"

Records = Sequence[Mapping[str, float]]


def training_curves(records: Records, *, title: str = "") -> Figure:
    """Draw every metric of a run over its steps.

    Args:
        records: Lines of a run's log: ``step`` and the metrics measured there; ``val_NAME`` is drawn in the
            panel of ``NAME``. Positive values that span more than a factor of ten get a logarithmic axis.
        title: Headline.

    Returns:
        A matplotlib figure on the Agg canvas, independent of pyplot.

    Raises:
        ValueError: If there is nothing to draw.
    """
    names = list(dict.fromkeys(key.removeprefix(_VALIDATION) for record in records for key in record))
    names = [name for name in names if name != _STEP]
    if not names:
        raise ValueError("`records` holds no metric, so there is no curve to draw.")
    rows = math.ceil(len(names) / _COLUMNS)
    figure = Figure(
        figsize=(_COLUMNS * _PANEL[0], rows * _PANEL[1]), facecolor=palette.PAPER, layout="constrained"
    )
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=14, fontweight="bold", color=palette.INK, parse_math=False)
    for index, name in enumerate(names):
        _draw_metric(figure.add_subplot(rows, _COLUMNS, index + 1), records, name)
    return figure


def save_training_curves(records: Records, path: Path, *, title: str = "") -> Path:
    """Write :func:`training_curves` as a picture; returns ``path``.

    Raises:
        ValueError: As :func:`training_curves`.
    """
    figure = training_curves(records, title=title)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced_on_success(path) as partial:
        figure.savefig(partial, dpi=100)
    return path


def _draw_metric(axes: Axes, records: Records, name: str) -> None:
    shown: list[float] = []
    for key, label, color, style in (
        (name, "training", palette.LEFT, "-"),
        (_VALIDATION + name, "validation", palette.RIGHT, "o-"),
    ):
        points = [(r[_STEP], r[key]) for r in records if key in r and math.isfinite(r[key])]
        if points:
            steps, values = zip(*points, strict=True)
            axes.plot(steps, values, style, color=color, label=label, linewidth=1.2, markersize=3)
            shown += values
    if shown and min(shown) > 0 and max(shown) > 10 * min(shown):
        axes.set_yscale("log")
    axes.set_title(name, fontsize=11, color=palette.INK)
    axes.set_xlabel(_STEP, fontsize=9, color=palette.FAINT)
    axes.grid(color=palette.GRID)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, frameon=False)
