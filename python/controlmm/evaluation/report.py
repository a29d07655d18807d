"""Results as Markdown for people and as JSON for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from controlmm.evaluation.intervals import Interval
from controlmm.evaluation.reconstruction import CodeStatistics
from controlmm.evaluation.scores import RowScores

RESULTS_MARKDOWN, RESULTS_JSON = "results.md", "results.json"


@dataclass(frozen=True)
class Column:
    """A column of a table: its title, the metric it shows and how."""

    title: str
    metric: str
    digits: int = 3
    factor: float = 1.0

    def cell(self, row: RowScores) -> str:
        """The metric of a row, or ``-`` where it does not apply."""
        found = row[self.metric] if self.metric in row.repeats else Interval(math.nan, 0.0)
        if math.isnan(found.mean):
            return "-"
        return Interval(self.factor * found.mean, self.factor * found.half_width).shown(self.digits)


QUALITY = (
    Column("R@1 ↑", "r1"),
    Column("R@2 ↑", "r2"),
    Column("R@3 ↑", "r3"),
    Column("FID ↓", "fid"),
    Column("MM-Dist ↓", "mm_distance"),
    Column("Diversity →", "diversity"),
)
MULTIMODALITY = Column("Multimodality ↑", "multimodality")  # where it was measured
CONTROL = (
    Column("R@3 ↑", "r3"),
    Column("FID ↓", "fid"),
    Column("Diversity →", "diversity"),
    Column("Skating ↓", "skating_published", 4),
    Column("Traj. err. 50 cm ↓", "trajectory_50_joint", 4),
    Column("Loc. err. 50 cm ↓", "location_50_joint", 4),
    Column("Avg. err. (m) ↓", "average_joint", 4),
    Column("s a clip", "seconds", 2),
)
MORE_CONTROL = (
    Column("Traj. 20 cm", "trajectory_20_joint", 4),
    Column("Loc. 20 cm", "location_20_joint", 4),
    Column("Traj. 50 cm by frame", "trajectory_50_frame", 4),
    Column("Loc. 50 cm by frame", "location_50_frame", 4),
    Column("Avg. by frame (m)", "average_frame", 4),
)
PHYSICS = (
    Column("Skating, masked", "skating", 4),
    Column("Below floor (cm)", "penetration", 2, 100.0),
    Column("Jerk (m/s³)", "jerk", 1),
    Column("Bone deviation (mm)", "bone_deviation", 2, 1000.0),
    Column("Contacts right", "contact_consistency", 3),
    Column("To recording, root aligned (cm)", "distance_to_real", 1, 100.0),
    Column("FID of two halves", "fid_halves"),
)


@dataclass(frozen=True)
class ResultPage:
    """One evaluation: what was run, and its rows.

    Attributes:
        title: Heading.
        facts: What must be said beside the numbers: command, revision, machine, seconds, data, captions.
        rows: Scores.
        caution: A sentence at the foot.
    """

    title: str
    facts: Mapping[str, Any]
    rows: Sequence[RowScores]
    caution: str
    codes: Mapping[str, CodeStatistics] = field(default_factory=dict)  # by tokenizer

    def write(self, out: Path) -> None:
        """Write ``results.md`` and ``results.json`` into ``out``."""
        (out / RESULTS_MARKDOWN).write_text(self.markdown(), encoding="utf-8")
        content = {"title": self.title, **self.facts, "caution": self.caution}
        content["rows"] = [row.as_json() for row in self.rows]
        content["codes"] = {name: _plain_codes(codes) for name, codes in self.codes.items()}
        write_json(out / RESULTS_JSON, content)

    def markdown(self) -> str:
        """The page with all tables."""
        facts = "\n".join(f"- {name}: {value}" for name, value in self.facts.items())
        tables = [
            f"## {heading}\n\n{markdown_table(self.rows, columns)}"
            for heading, columns in (
                ("Text", self._quality()), ("Control", CONTROL), ("Control, other counts", MORE_CONTROL),
                ("Motion", PHYSICS),
            )
        ]  # fmt: skip
        if self.codes:
            tables.append(f"## Codes of the tokenizer\n\n{codes_table(self.codes)}")
        return "\n\n".join([f"# {self.title}", facts, *tables, self.caution]) + "\n"

    def _quality(self) -> tuple[Column, ...]:
        is_measured = any(MULTIMODALITY.metric in row.repeats for row in self.rows)
        return (*QUALITY, MULTIMODALITY) if is_measured else QUALITY


def codes_table(codes: Mapping[str, CodeStatistics]) -> str:
    """Perplexity and usage of each layer, a line a tokenizer and statistic."""
    layers = max(len(found.usage) for found in codes.values())
    cells = []
    for name, found in codes.items():
        for title, values in (
            (f"{name}, perplexity of {found.codebook_size}", [f"{v:.0f}" for v in found.perplexity.tolist()]),
            (f"{name}, codes in use", [f"{v:.0%}" for v in found.usage.tolist()]),
        ):
            cells.append([title, *values, *[""] * (layers - len(values))])
    return pipe_table(["layer", *map(str, range(layers))], cells)


def _plain_codes(codes: CodeStatistics) -> dict[str, Any]:
    return {
        "codebook_size": codes.codebook_size,
        "perplexity": [round(value, 2) for value in codes.perplexity.tolist()],
        "usage": [round(value, 4) for value in codes.usage.tolist()],
    }


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write ``content``, indented."""
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def markdown_table(rows: Sequence[RowScores], columns: Sequence[Column]) -> str:
    """A pipe table, a line a row."""
    cells = [[row.label, *(column.cell(row) for column in columns)] for row in rows]
    return pipe_table(["", *(column.title for column in columns)], cells)


def pipe_table(titles: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
    """Markdown of a table with the first column to the left and the others to the right."""
    rule = ["---", *["---:"] * (len(titles) - 1)]
    return "\n".join("| " + " | ".join(line) + " |" for line in (titles, rule, *cells))
