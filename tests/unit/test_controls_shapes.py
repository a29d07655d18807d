"""Ready-made controls: their geometry, their speed, and the example files made of them.

The files in ``examples/controls`` are the shapes' defaults. To write them anew:
``controlmm controls line --out examples/controls/walk_line.json`` and so on, or :func:`write_examples` below.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
import torch

from controlmm.controls import JointControl, PathControl, densify, load_controls, save_controls
from controlmm.controls.shapes import (
    MAX_SECONDS,
    SHAPES,
    TOP_SPEED,
    WALKING_SPEED,
    circle,
    line,
    reach,
    wave,
    zigzag,
)
from controlmm.motion.skeleton import HUMANML3D

EXAMPLES_FOLDER = Path(__file__).parents[2] / "examples" / "controls"
EXAMPLES = {
    "walk_line": line,
    "circle": circle,
    "zigzag": zigzag,
    "wrist_wave": wave,
    "reach_keyframes": reach,
}
ROUNDING = 1e-4  # metres; shapes are rounded to a tenth of a millimetre
CHORD = 1e-3  # metres; a circle of 121 points lies that far inside the round one


def write_examples() -> None:
    for name, shape in EXAMPLES.items():
        save_controls(shape(), EXAMPLES_FOLDER / f"{name}.json")


def targets_of(file):
    dense = densify(file.controls, round(file.seconds * 20))
    joint = dense.controlled_joints[-1]
    return dense.targets[:, joint], dense.mask[:, joint]


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_files_are_what_the_shapes_make(tmp_path, name):
    made = save_controls(EXAMPLES[name](), tmp_path / "made.json")
    assert (EXAMPLES_FOLDER / f"{name}.json").read_text(encoding="utf-8") == made.read_text(encoding="utf-8")


@pytest.mark.parametrize("path", sorted(EXAMPLES_FOLDER.glob("*.json")), ids=lambda path: path.stem)
def test_example_files_load_and_fit_their_clip(path):
    file = load_controls(path)
    assert file.text
    assert not densify(file.controls, round(file.seconds * 20)).is_empty


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES.keys())
def test_defaults_warn_of_nothing_and_fit_the_models(shape):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        file = shape()
    assert 8 <= round(file.seconds * 20) <= 196


@pytest.mark.parametrize("shape", [line, circle, zigzag], ids=lambda shape: shape.__name__)
def test_ground_paths_start_at_the_origin_at_walking_speed_with_free_height(shape):
    file = shape()
    (control,) = file.controls
    assert isinstance(control, PathControl)
    points, mask = targets_of(file)
    assert mask.tolist() == [[True, False, True]] * len(points)
    assert points[0].tolist() == [0, 0, 0]
    speed = control.length / file.seconds
    assert 0.95 * WALKING_SPEED <= speed <= 1.1 * WALKING_SPEED


def test_a_line_runs_along_z():
    points, _ = targets_of(line(length=3.0, seconds=2.0))
    assert len(points) == 40
    assert not points[:, 0].any()
    assert points[-1, 2] == 3.0


@pytest.mark.parametrize(("direction", "side"), [("left", 1.0), ("right", -1.0)])
def test_a_circle_turns_to_its_side_and_closes(direction, side):
    points, _ = targets_of(circle(radius=2.0, direction=direction))
    centre = torch.tensor([2.0 * side, 0.0, 0.0])
    torch.testing.assert_close(
        (points - centre).norm(dim=1), torch.full((196,), 2.0), rtol=0.0, atol=CHORD + ROUNDING
    )
    assert points[-1].norm() < ROUNDING
    assert points[1, 2] > 10 * abs(points[1, 0])  # it starts along +Z
    assert points[98, 0] * side == pytest.approx(4.0, abs=0.01)


def test_a_zigzag_swings_to_both_sides_as_often_as_asked():
    points, _ = targets_of(zigzag(length=6.0, width=1.2, turns=4))
    assert points[-1, 2] == pytest.approx(6.0, abs=ROUNDING)
    assert points[:, 0].max() == pytest.approx(0.6, abs=0.02)
    assert points[:, 0].min() == pytest.approx(-0.6, abs=0.02)
    turning = torch.diff(torch.sign(torch.diff(points[:, 0])))
    assert int((turning != 0).sum()) == 4


@pytest.mark.parametrize(("joint", "side"), [("right_wrist", -1), ("left_wrist", 1)])
def test_a_wave_stays_in_reach_of_the_walking_shoulder(joint, side):
    file = wave(joint, amplitude=0.2, length=4.0)
    (control,) = file.controls
    assert isinstance(control, JointControl)
    assert control.mask.all()
    points = control.positions
    assert (points[:, 0] * side > 0).all()
    assert points[:, 1].max() == pytest.approx(1.4, abs=0.01)
    assert points[:, 1].min() == pytest.approx(1.0, abs=0.01)
    pelvis_z = torch.linspace(0.0, 4.0, len(points))
    shoulder = torch.stack(
        [torch.full_like(pelvis_z, 0.17 * side), torch.full_like(pelvis_z, 1.4), pelvis_z], dim=1
    )
    arm = sum(HUMANML3D.bone_lengths[-4:]) / 2  # upper arm and forearm, mean of both sides
    assert (points - shoulder).norm(dim=1).max() < arm


def test_a_wave_names_the_hand_that_waves():
    assert "left hand" in wave("left_wrist").text
    assert "right hand" in wave().text


def test_a_reach_has_only_key_frames():
    dense = densify(reach(seconds=4.0).controls, 80)
    assert dense.controlled_joints == (0, 21)
    assert dense.mask.any(dim=2).sum() == 5


def test_seconds_are_kept_and_the_verb_follows_the_speed():
    assert line(length=6.0, seconds=5.0).seconds == 5.0
    assert "walks" in line(length=6.0, seconds=5.0).text
    assert "runs" in line(length=6.0, seconds=2.5).text


def test_other_joints_can_be_led():
    assert targets_of(circle("head"))[0].shape == (196, 3)
    assert circle("head").controls[0].joint == "head"


@pytest.mark.parametrize(
    "make", [lambda: line(length=40.0), lambda: circle(radius=3, seconds=5), lambda: wave(length=40)]
)
def test_a_way_that_is_too_fast_is_warned_of(make):
    with pytest.warns(UserWarning, match=rf"m/s; above {TOP_SPEED:g} m/s the motion will look wrong"):
        file = make()
    assert file.seconds <= MAX_SECONDS


def test_a_wave_out_of_reach_is_warned_of():
    with pytest.warns(
        UserWarning, match=r"wrist heights from 0\.70 to 1\.70 m; there the arm reaches from 0\.95"
    ):
        wave(amplitude=0.5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: line(length=0), "`length` must be positive, got 0"),
        (lambda: circle(radius=-1), "`radius` must be positive, got -1"),
        (lambda: circle(direction="up"), "`direction` must be 'left' or 'right', got 'up'"),
        (lambda: zigzag(turns=0), "`turns` must be positive, got 0"),
        (lambda: zigzag(width=float("nan")), "`width` must be positive, got nan"),
        (lambda: line(seconds=0.3), r"`seconds` must be from 0\.4 to 9\.8 \(8 to 196 frames\), got 0\.3"),
        (lambda: reach(seconds=10), r"`seconds` must be from 0\.4 to 9\.8 \(8 to 196 frames\), got 10"),
        (lambda: wave("head"), "`joint` must be one of left_wrist, right_wrist, got 'head'"),
        (lambda: circle("tail"), 'Unknown joint "tail"'),
    ],
)
def test_bad_arguments_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
