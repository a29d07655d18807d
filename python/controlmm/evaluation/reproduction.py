"""Our rows for a table of a paper, under its own columns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from controlmm.evaluation.protocol import Row
from controlmm.evaluation.published_tables import PublishedTable, published_table
from controlmm.evaluation.report import Column, pipe_table
from controlmm.evaluation.scores import RowScores

# The papers' titles of columns, and what we put there. Errors of several joints go by the stricter rule
# (each joint by itself), which is the same for one joint.
_METRICS = {
    "R1": Column("R1", "r1"),
    "R2": Column("R2", "r2"),
    "R3": Column("R3", "r3"),
    "FID": Column("FID", "fid"),
    "MM-Dist": Column("MM-Dist", "mm_distance"),
    "Div": Column("Div", "diversity"),
    "Skate": Column("Skate", "skating_published", 4),
    "Traj": Column("Traj", "trajectory_50_joint", 4),
    "Loc": Column("Loc", "location_50_joint", 4),
    "Avg": Column("Avg", "average_joint", 4),
    "Traj %": Column("Traj %", "trajectory_50_joint", 2, 100.0),
    "Loc %": Column("Loc %", "location_50_joint", 2, 100.0),
    "Avg cm": Column("Avg cm", "average_joint", 2, 100.0),
    "speed (s)": Column("speed (s)", "seconds", 2),
}
SECONDS = Column("s a clip", "seconds", 2)


@dataclass(frozen=True)
class Line:
    """A row of ours with the cells that say what it is, under the table's first columns."""

    keys: tuple[str, ...]
    row: Row


@dataclass(frozen=True)
class Reproduction:
    """How a table is made again.

    Attributes:
        name: Of the published table.
        lines: Our rows.
        average: Keys of a line that is the mean of lines, and the numbers of those.
        own_table: For tables that are not a line a system: makes titles and lines of ours from the scores.
        columns: For figures, whose numbers the paper does not give: titles of our columns.
        extra: Columns of ours that the paper does not have.
        notes: Sentences for the foot.
    """

    name: str
    lines: Sequence[Line]
    average: tuple[tuple[str, ...], Sequence[int]] | None = None
    own_table: Callable[[Sequence[RowScores]], tuple[list[str], list[list[str]]]] | None = None
    columns: tuple[str, ...] = ()
    extra: Sequence[Column] = ()
    notes: Sequence[str] = ()

    @property
    def published(self) -> PublishedTable:
        """The paper's table; for a figure one without rows."""
        if self.columns:
            return PublishedTable(self.name, "a figure without printed numbers", self.columns, ())
        return published_table(self.name)

    @property
    def rows(self) -> list[Row]:
        """Everything that has to be evaluated."""
        return [line.row for line in self.lines]

    def markdown(self, scores: Sequence[RowScores]) -> str:
        """The published table with our rows under it.

        Args:
            scores: Of :attr:`rows`, in their order.
        """
        published = self.published
        if self.own_table is not None:
            titles, cells = self.own_table(scores)
            theirs = pipe_table(published.columns, published.rows)
            return f"Published:\n\n{theirs}\n\nOurs:\n\n{pipe_table(titles, cells)}"
        columns = [_METRICS[title] for title in published.columns if title in _METRICS]
        keys = [title for title in published.columns if title not in _METRICS]
        own = [*columns, SECONDS, *self.extra]
        titles = [*keys, "", *(column.title for column in own)]
        blank = [""] * (len(own) - len(columns))
        theirs_cells = [
            [*row[: len(keys)], "published", *_ordered(published, row, columns), *blank]
            for row in published.rows
        ]
        ours = [
            [*line_keys, "ours", *(column.cell(score) for column in own)]
            for line_keys, score in self._with_average(scores)
        ]
        return pipe_table(titles, theirs_cells + ours)

    def _with_average(self, scores: Sequence[RowScores]) -> list[tuple[tuple[str, ...], RowScores]]:
        found = [(line.keys, score) for line, score in zip(self.lines, scores, strict=True)]
        if self.average is not None:
            keys, numbers = self.average
            found.insert(max(numbers) + 1, (keys, mean_of([scores[number] for number in numbers])))
        return found


def mean_of(scores: Sequence[RowScores]) -> RowScores:
    """A row that is the mean of others, repeat by repeat."""
    repeats = {
        name: [sum(values) / len(scores) for values in zip(*(s.repeats[name] for s in scores), strict=True)]
        for name in scores[0].repeats
    }
    about = {"average of": [score.label for score in scores]}
    return RowScores("average", repeats, scores[0].clips, about)


def _ordered(table: PublishedTable, row: Sequence[str], columns: Sequence[Column]) -> list[str]:
    return [row[table.columns.index(column.title)] for column in columns]
