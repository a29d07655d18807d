"""Plain text tables for a terminal."""

from __future__ import annotations

from collections.abc import Sequence


def format_table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns as wide as their longest cell, right-aligned, two spaces apart.

    Raises:
        ValueError: If a row has another number of cells than there are titles.
    """
    widths = [len(title) for title in titles]
    for row in rows:
        widths = [max(width, len(cell)) for width, cell in zip(widths, row, strict=True)]
    rule = ["-" * width for width in widths]
    lines = (
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        for row in (titles, rule, *rows)
    )
    return "\n".join(lines)
