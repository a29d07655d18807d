"""The stored tables are the papers' (checked against the reference copy where it is there)."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from controlmm.evaluation.published_tables import published_names, published_table


def test_some_numbers_known_by_heart() -> None:
    table = published_table("table1")
    row = next(r for r in table.rows if r[:3] == ("pelvis-only", "ControlMM", "pelvis"))
    assert dict(zip(table.columns, row, strict=True))["FID"] == "0.061"
    assert published_table("table6").rows == (("0.35", "0.24", "24.65", "46.5", "71.73"),)


def test_every_row_is_as_wide_as_its_table() -> None:
    for name in published_names():
        table = published_table(name)
        assert all(len(row) == len(table.columns) for row in table.rows), name


def test_unknown_tables_are_named() -> None:
    with pytest.raises(ValueError, match=r"Unknown table 'table0'\. Tables: table1, table2"):
        published_table("table0")


def test_all_numbers_are_those_of_the_reference(shared: Path) -> None:
    text = (shared / "reference" / "paper_tables.md").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if line.startswith("|")]
    expected = sorted(tuple(re.findall(r"\d+\.\d+", line)) for line in lines if re.search(r"\d\.\d", line))
    stored = [row for name in published_names() for row in published_table(name).rows]
    found = sorted(tuple(re.findall(r"\d+\.\d+", " ".join(row))) for row in stored)
    assert [row for row in found if row] == expected
