"""Which picture goes with which reproduced table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from controlmm.evaluation.reproduction import Reproduction
    from controlmm.evaluation.scores import RowScores

_CURVES = {  # table: title of its x axis
    "table4": "keyframes", "table8": "decoding steps", "table9": "decoding steps",
    "tl-table4": "accuracy setting", "tl-figure7": "share of frames that is masked",
}  # fmt: skip
_PANELS = {  # metric: title and factor
    "average_joint": ("average error (cm)", 100.0),
    "fid": ("FID", 1.0),
    "r3": ("R-precision, top 3", 1.0),
    "seconds": ("seconds a clip", 1.0),
}


def save_pictures(
    table: Reproduction, scores: Sequence[RowScores], out: Path, *, effort: float
) -> list[Path]:
    """Figure 2 for table 5, curves for tables of one changing number; nothing for the others.

    ``effort``, the share of the papers' iterations, is said in the picture unless it is 1.
    """
    aside = "" if effort == 1 else f", {effort:g} of the iterations"
    if table.name == "table5":
        return [_tradeoff(table, scores, out / "figure2.png", aside)]
    if table.name in _CURVES:
        return [_curves(table, scores, out / f"{table.name}.png", aside)]
    return []


def _tradeoff(table: Reproduction, scores: Sequence[RowScores], path: Path, aside: str) -> Path:
    from controlmm.viewer.evaluation_charts import save_tradeoff

    published, columns = table.published, table.published.columns
    name, seconds, fid, error = (columns.index(title) for title in ("model", "speed (s)", "FID", "Avg"))
    theirs = [(r[name], float(r[seconds]), 100 * float(r[error]), float(r[fid])) for r in published.rows]
    ours = [
        (line.keys[0], s["seconds"].mean, 100 * s["average_joint"].mean, s["fid"].mean)
        for line, s in zip(table.lines, scores, strict=True)
    ]
    groups = {
        "published (A100, published evaluator)": theirs,
        f"ours (this machine and evaluator{aside})": ours,
    }
    return save_tradeoff(groups, path, title="Error, FID and time")


def _curves(table: Reproduction, scores: Sequence[RowScores], path: Path, aside: str) -> Path:
    from controlmm.viewer.evaluation_charts import save_curves

    x = list(dict.fromkeys(line.keys[-1].split(",")[0] for line in table.lines))
    systems: dict[str, list[RowScores]] = {}
    for line, score in zip(table.lines, scores, strict=True):
        systems.setdefault(_system_of(line.keys) or f"paper's settings{aside}", []).append(score)
    panels: Mapping[str, dict[str, list[float]]] = {
        title: {name: [factor * s[metric].mean for s in found] for name, found in systems.items()}
        for metric, (title, factor) in _PANELS.items()
    }
    return save_curves(x, panels, path, x_title=_CURVES[table.name])


def _system_of(keys: Sequence[str]) -> str:
    """The first cell of lines with two, what follows a comma in lines with one: nothing for the paper's."""
    return keys[0] if len(keys) > 1 else keys[0].partition(", ")[2]
