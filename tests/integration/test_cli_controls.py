"""``controlmm controls``: its files are those of the shapes, and the examples are its defaults."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import pytest

from controlmm.controls import load_controls, save_controls
from controlmm.controls.shapes import circle, line, reach, wave, zigzag

Command = Callable[..., str]
EXAMPLES = Path(__file__).parents[2] / "examples" / "controls"
DEFAULTS = {
    "line": "walk_line",
    "circle": "circle",
    "zigzag": "zigzag",
    "wave": "wrist_wave",
    "reach": "reach_keyframes",
}


@pytest.mark.parametrize("shape", DEFAULTS)
def test_defaults_are_the_examples(shape: str, command: Command, tmp_path: Path) -> None:
    printed = command("controls", shape, "--out", tmp_path / "made.json")
    assert (tmp_path / "made.json").read_bytes() == (EXAMPLES / f"{DEFAULTS[shape]}.json").read_bytes()
    file = load_controls(tmp_path / "made.json")
    assert printed.splitlines()[0] == f"{tmp_path / 'made.json'}: {file.seconds:g} s, prompt {file.text!r}"


OPTIONS = {
    "line": (["--joint", "head", "--length", 3, "--seconds", 4], line("head", length=3.0, seconds=4.0)),
    "circle": (
        ["--joint", "pelvis", "--radius", 1, "--direction", "right", "--seconds", 8],
        circle("pelvis", radius=1.0, direction="right", seconds=8.0),
    ),
    "zigzag": (
        ["--length", 4, "--width", 1, "--turns", 2, "--seconds", 5],
        zigzag(length=4.0, width=1.0, turns=2, seconds=5.0),
    ),
    "wave": (
        ["--joint", "left_wrist", "--amplitude", 0.1, "--length", 3, "--period", 2, "--seconds", 5],
        wave("left_wrist", amplitude=0.1, length=3.0, period=2.0, seconds=5.0),
    ),
    "reach": (["--joint", "left_wrist", "--seconds", 3], reach("left_wrist", seconds=3.0)),
}


@pytest.mark.parametrize("shape", OPTIONS)
def test_every_option_reaches_the_shape(shape: str, command: Command, tmp_path: Path) -> None:
    arguments, expected = OPTIONS[shape]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        command("controls", shape, *arguments, "--out", tmp_path / "made.json")
    save_controls(expected, tmp_path / "expected.json")
    assert (tmp_path / "made.json").read_bytes() == (tmp_path / "expected.json").read_bytes()


def test_bad_sizes_and_joints_are_refused(refused: Command, tmp_path: Path) -> None:
    assert "`radius` must be positive" in refused(
        "controls", "circle", "--radius", 0, "--out", tmp_path / "a.json"
    )
    assert 'Unknown joint "tail"' in refused(
        "controls", "line", "--joint", "tail", "--out", tmp_path / "a.json"
    )
    assert "controls are written as .json" in refused("controls", "line", "--out", tmp_path / "a.csv")
    assert list(tmp_path.iterdir()) == []
