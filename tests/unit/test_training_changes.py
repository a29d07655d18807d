"""Options of training that are set by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import pytest

from controlmm.training.changes import with_changes
from controlmm.training.control import ControlOptions


@dataclass(frozen=True)
class Example:
    count: int = 1
    share: float | None = None
    mode: Literal["a", "b"] = "a"
    on: bool = True
    joints: tuple[int, ...] = (0,)


def test_options_are_set_by_name_in_the_part_that_has_them():
    given = {"count": "3", "share": "0.5", "mode": "b", "on": "false", "joints": "0,20", "alpha": "0.3"}
    parts = with_changes({"config": Example(), "options": ControlOptions()}, given)
    assert parts["config"] == Example(3, 0.5, "b", False, (0, 20))
    assert parts["options"] == ControlOptions(alpha=0.3)
    assert with_changes({"config": Example(share=1.0)}, {"share": "none"})["config"].share is None
    assert with_changes({"config": Example(), "options": None}, {}) == {"config": Example(), "options": None}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"colour": "red"}, r"There is no option 'colour'\. Options: count, joints, mode, on, share\."),
        ({"count": "many"}, r"Option 'count' must be a value of type int, got 'many'\."),
        ({"mode": "c"}, r"Option 'mode' must be one of a, b, got 'c'\."),
        ({"on": "yes"}, r"Option 'on' must be one of true, false, got 'yes'\."),
    ],
)
def test_unknown_options_and_values_are_named(given, message):
    with pytest.raises(ValueError, match=message):
        with_changes({"config": Example()}, given)
