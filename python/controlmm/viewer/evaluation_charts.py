"""Pictures of evaluations: error, quality and time against each other, curves, confidence maps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from controlmm.io.atomic import replaced_on_success
from controlmm.viewer import palette

_PANEL = (4.6, 3.4)  # inches
_LARGEST, _SMALLEST = 900.0, 60.0  # area of a bubble, points^2

Point = tuple[str, float, float, float]  # label, seconds, error in centimetres, FID


def save_tradeoff(groups: Mapping[str, Sequence[Point]], path: Path, *, title: str = "") -> Path:
    """Bubbles over FID and error, the larger the slower (ControlMM, Figure 2); one panel a group.

    FIDs of different evaluators must not share a panel: give them as different groups.
    """
    figure = _figure(len(groups), title)
    for number, (name, points) in enumerate(groups.items(), start=1):
        axes = figure.add_subplot(1, len(groups), number)
        slowest = max(seconds for _, seconds, *_ in points)
        for index, (label, seconds, error, fid) in enumerate(points):
            area = max(_SMALLEST, _LARGEST * seconds / slowest)
            color = palette.CONTROL[index % len(palette.CONTROL)]
            axes.scatter(fid, max(error, 1e-3), s=area, color=color, alpha=0.6, edgecolors=palette.INK)
            axes.annotate(
                f"{label}, {seconds:.3g} s", (fid, max(error, 1e-3)), xytext=(7, 5),
                textcoords="offset points", fontsize=7, color=palette.INK,
            )  # fmt: skip
        axes.set_yscale("log")
        axes.margins(0.25)
        _label(axes, name, "FID", "average error (cm)")
    return _saved(figure, path)


def save_curves(
    x: Sequence[str], panels: Mapping[str, Mapping[str, Sequence[float]]], path: Path, *, x_title: str = ""
) -> Path:
    """A panel for each metric, a line for each system, over the settings ``x`` (equal distances)."""
    figure = _figure(len(panels), "")
    for number, (metric, lines) in enumerate(panels.items(), start=1):
        axes = figure.add_subplot(1, len(panels), number)
        for index, (system, values) in enumerate(lines.items()):
            color = palette.CONTROL[index % len(palette.CONTROL)]
            axes.plot(range(len(x)), values, "o-", color=color, label=system, linewidth=1.4, markersize=4)
        axes.set_xticks(range(len(x)), x)
        _label(axes, metric, x_title, "")
        axes.legend(fontsize=7, frameon=False)
    return _saved(figure, path)


def save_confidence(
    maps: Mapping[str, Float[Tensor, "S L"]], means: Mapping[str, Float[Tensor, "S"]], path: Path
) -> Path:
    """A map over steps and tokens for each case, and the means over the steps (ControlMM, Figures 7 to 11).

    Args:
        maps: Confidence by step and position, from 0 to 1.
        means: Over all tokens, for the same cases.
        path: Picture to write.
    """
    columns = 3
    rows = math.ceil((len(maps) + 1) / columns)
    figure = _figure(columns, "Confidence of the tokens drawn in each step", rows=rows)
    for number, (label, confidence) in enumerate(maps.items(), start=1):
        axes = figure.add_subplot(rows, columns, number)
        steps, tokens = confidence.shape
        image = axes.imshow(
            confidence.numpy(), aspect="auto", vmin=0, vmax=1, cmap="viridis", interpolation="nearest",
            extent=(0.5, tokens + 0.5, steps + 0.5, 0.5),
        )  # fmt: skip
        figure.colorbar(image, ax=axes).ax.tick_params(labelsize=6)
        _label(axes, label, "token", "step")
        axes.grid(visible=False)
    axes = figure.add_subplot(rows, columns, len(maps) + 1)
    for index, (label, mean) in enumerate(means.items()):
        color = palette.CONTROL[index % len(palette.CONTROL)]
        axes.plot(range(1, len(mean) + 1), mean.tolist(), "o-", color=color, label=label, markersize=4)
    _label(axes, "mean over tokens", "step", "confidence")
    axes.legend(fontsize=7, frameon=False)
    return _saved(figure, path)


def _figure(panels: int, title: str, *, rows: int = 1) -> Figure:
    figure = Figure(
        figsize=(_PANEL[0] * panels, _PANEL[1] * rows), facecolor=palette.PAPER, layout="constrained"
    )
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, fontsize=12, fontweight="bold", color=palette.INK, parse_math=False)
    return figure


def _label(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=10, color=palette.INK)
    axes.set_xlabel(x, fontsize=8, color=palette.FAINT)
    axes.set_ylabel(y, fontsize=8, color=palette.FAINT)
    axes.tick_params(labelsize=7)
    axes.grid(color=palette.GRID)


def _saved(figure: Figure, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced_on_success(path) as partial:
        figure.savefig(partial, dpi=110)
    return path
