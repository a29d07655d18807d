"""The table of docs/fidelity.md holds the 22 rows, and names options that exist, with their defaults."""

from __future__ import annotations

import dataclasses
import inspect
import re
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from controlmm.training.changes import with_changes
from controlmm.training.rvq import SETTINGS

PAGE = (Path(__file__).parents[2] / "docs" / "fidelity.md").read_text(encoding="utf-8")
HOME = {
    "ControlBranchConfig": "controlmm.models.control_branch",
    "ControlOptions": "controlmm.training.control",
    "ControlSetting": "controlmm.evaluation.control_draws",
    "DecodingRules": "controlmm.generation.decoding_rules",
    "EditingBudget": "controlmm.generation.editing",
    "MaskedOptions": "controlmm.training.masked",
    "MaskedTransformerConfig": "controlmm.models.masked_transformer",
    "PartVqVaeConfig": "controlmm.models.part_vq_vae",
    "Preset": "controlmm.pipelines.presets",
    "ResidualTransformerConfig": "controlmm.models.residual_transformer",
    "RvqOptions": "controlmm.training.rvq",
    "RvqVaeConfig": "controlmm.models.rvq_vae",
    "obstacle_loss": "controlmm.ops",
}
NEEDED = {"Preset": {"budget": None}, "ControlSetting": {"control": "pelvis"}}  # fields without a default
OPTION = re.compile(r"`([A-Za-z_]\w*)(?:\.(\w+)|\((\w+)\))`")


def table(heading: str) -> list[list[str]]:
    """Cells of the rows of the table below ``heading``."""
    section = PAGE.split(f"## {heading}\n")[1].split("\n## ")[0]
    rows = [line.strip("|").split("|") for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row] for row in rows[2:]]


DIFFERENCES = [
    SimpleNamespace(
        **dict(zip(("number", "topic", "paper", "code", "option", "default", "reason"), row, strict=True))
    )
    for row in table("The 22 differences")
]


def instance(name: str) -> Any:
    """A dataclass with its defaults."""
    if name == "TrainingSettings":
        return SETTINGS["paper"]
    return getattr(import_module(HOME[name]), name)(**NEEDED.get(name, {}))


def default_of(owner: str, field: str) -> object:
    if owner in HOME and inspect.isfunction(getattr(import_module(HOME[owner]), owner)):
        return inspect.signature(getattr(import_module(HOME[owner]), owner)).parameters[field].default
    return getattr(instance(owner), field)


def test_all_rows_are_there_in_order():
    assert [row.number for row in DIFFERENCES] == [str(number) for number in range(1, 23)]
    assert [row.number for row in DIFFERENCES if not OPTION.search(row.option)] == ["19"]


@pytest.mark.parametrize("row", DIFFERENCES, ids=lambda row: row.topic)
def test_options_exist_with_the_defaults_of_the_table(row):
    options = [(owner, field or argument) for owner, field, argument in OPTION.findall(row.option)]
    defaults = re.findall(r"`([^`]+)`", row.default)
    assert [str(default_of(*option)) for option in options] == defaults


@pytest.mark.parametrize("row", DIFFERENCES, ids=lambda row: row.topic)
def test_the_values_of_paper_and_code_can_be_set(row):
    fields = {field: owner for owner, field, _ in OPTION.findall(row.option) if field}
    for name, value in re.findall(r"`(\w+)=([^`]+)`", row.paper + row.code + row.reason):
        owner = instance(fields[name])
        changed = with_changes({"part": owner}, {name: value})["part"]
        assert str(getattr(changed, name)).lower() in (value, f"{value}.0")


def test_every_option_that_the_page_names_exists():
    for owner, field, argument in OPTION.findall(PAGE):
        if owner in HOME:
            default_of(owner, field or argument)
    assert {owner for owner, _, _ in OPTION.findall(PAGE)} - {"TrainingSettings"} == set(HOME)


def test_every_field_of_the_options_is_on_the_page():
    """A new option of these classes must be explained where the others are."""
    for name in ("ControlOptions", "MaskedOptions", "RvqOptions", "DecodingRules"):
        for field in dataclasses.fields(instance(name)):
            assert f"`{name}.{field.name}`" in PAGE
