"""Pictures of evaluations: error, quality and time against each other, curves, confidence maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
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
            axes.annotate(f"{label}\n{seconds:.2g} s", (fid, max(error, 1e-3)), fontsize=7, color=palette.INK)
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


def save_confidence(records: Mapping[str, Float[Tensor, "S L"]], path: Path) -> Path:
    """A map over steps and tokens for each record, and their means over the steps (Figures 7 to 11)."""
    figure = _figure(len(records) + 1, "Confidence of the tokens drawn in each step")
    for number, (label, confidence) in enumerate(records.items(), start=1):
        axes = figure.add_subplot(1, len(records) + 1, number)
        axes.imshow(
            confidence.numpy(), aspect="auto", vmin=0, vmax=1, cmap="viridis", interpolation="nearest"
        )
        _label(axes, label, "token", "step")
        axes.grid(visible=False)
    axes = figure.add_subplot(1, len(records) + 1, len(records) + 1)
    for index, (label, confidence) in enumerate(records.items()):
        color = palette.CONTROL[index % len(palette.CONTROL)]
        axes.plot(torch.arange(1, len(confidence) + 1), confidence.nanmean(1), "o-", color=color, label=label)
    _label(axes, "mean", "step", "confidence")
    axes.legend(fontsize=6, frameon=False)
    return _saved(figure, path)


def _figure(panels: int, title: str) -> Figure:
    figure = Figure(figsize=(_PANEL[0] * panels, _PANEL[1]), facecolor=palette.PAPER, layout="constrained")
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
