"""Obstacles and timelines in control files: round trips, and the one line that each mistake gets."""

from __future__ import annotations

import pytest
import torch
from control_files import error_of, write

from controlmm.controls import load_controls, save_controls
from controlmm.controls.shape_fields import fields_of

SCENE = {
    "version": 1,
    "units": "m",
    "up": "y",
    "fps": 20,
    "obstacles": [
        {"type": "sphere", "center": [0.5, 0.9, 1.5], "radius": 0.4},
        {
            "type": "sphere",
            "center": [[2, 1, 2], [-2, 1, 2]],
            "radius": 0.4,
            "frames": [0, 60],
            "joints": ["head", 0],
        },
        {"type": "capsule", "start": [0, 0, 1], "end": [0, 2, 1], "radius": 0.1, "margin": 0.1},
        {
            "type": "box",
            "center": [1, 0.5, 2],
            "half_extents": [0.5, 0.5, 0.2],
            "yaw": 30,
            "joint_radius": 0.08,
        },
        {"type": "plane", "point": [0, 0, 3], "normal": [0, 0, 1]},
        {"type": "half_space", "point": [0, 0, 3], "normal": [0, 0, -1]},
        {"type": "height_field", "heights": [[0, 0.1], [0.2, 0.3]], "origin": [-1, -1], "spacing": [2, 2]},
    ],
    "timeline": [
        {"part": "lower", "prompt": "a person walks", "start": 0, "end": 6},
        {"part": "right_arm", "prompt": "a person waves", "start": 2.5, "end": 5},
    ],
}


def test_obstacles_and_timelines_survive_a_round_trip(tmp_path):
    first = load_controls(write(tmp_path / "scene.json", SCENE))
    save_controls(first, tmp_path / "again.json")
    second = load_controls(tmp_path / "again.json")
    assert second.timeline == first.timeline
    assert [entry.start for entry in first.timeline] == [0, 50]
    assert len(first.obstacles) == len(second.obstacles) == len(SCENE["obstacles"])
    for before, after in zip(first.obstacles, second.obstacles, strict=True):
        options = [(o.label, o.joints, o.margin, o.joint_radius) for o in (before, after)]
        assert options[0] == options[1]
        for name, value in fields_of(before.shape).items():
            assert torch.equal(getattr(after.shape, name), value)
    assert first.obstacles[1].frames.tolist() == [0, 60]


SCENE_MISTAKES = {
    "no type": (
        {"center": [0, 0, 0], "radius": 1},
        'obstacles[0]: missing key "type". It must be one of: sphere',
    ),
    "type": ({"type": "ball"}, "obstacles[0].type: must be one of sphere, capsule, box"),
    "key": (
        {"type": "sphere", "centre": [0, 0, 0]},
        'obstacles[0]: unknown key "centre". Did you mean "center"?',
    ),
    "shape": (
        {"type": "sphere", "center": [0, 0], "radius": 1},
        "obstacles[0]: `center` must have shape (3,)",
    ),
    "ragged": ({"type": "sphere", "center": [[0, 0, 0], [0, 0]], "radius": 1}, "obstacles[0]: "),
    "text": (
        {"type": "sphere", "center": [0, "a", 0], "radius": 1},
        "obstacles[0].center[1]: must be a number",
    ),
    "radius": (
        {"type": "sphere", "center": [0, 0, 0], "radius": -1},
        "obstacles[0]: `radius` must not be negative",
    ),
    "turns": (
        {
            "type": "box",
            "center": [0, 0, 0],
            "half_extents": [1, 1, 1],
            "yaw": 3,
            "rotation": [[1, 0, 0]] * 3,
        },
        'obstacles[0]: Give "rotation" or "yaw", not both.',
    ),
    "joint": (
        {"type": "plane", "point": [0, 0, 0], "normal": [0, 0, 1], "joints": ["hed"]},
        "obstacles[0]: Unknown joint",
    ),
    "margin": (
        {"type": "plane", "point": [0, 0, 0], "normal": [0, 0, 1], "margin": "1"},
        "obstacles[0].margin: must be",
    ),
}


@pytest.mark.parametrize(("item", "expected"), SCENE_MISTAKES.values(), ids=SCENE_MISTAKES.keys())
def test_a_mistake_in_an_obstacle_is_named_with_its_place(tmp_path, item, expected):
    document = {**SCENE, "obstacles": [item]}
    assert error_of(write(tmp_path / "a.json", document)).startswith(expected)


def test_a_mistake_in_a_timeline_is_named_with_its_place(tmp_path):
    for change, expected in (
        ({"part": "uper"}, 'timeline[0]: Unknown part "uper"'),
        ({"start": "0"}, "timeline[0].start: must be a number"),
        ({"end": 0.1}, "timeline[0]: An entry must begin at 0 or later and last at least 8 frames"),
    ):
        document = {**SCENE, "timeline": [{**SCENE["timeline"][0], **change}]}
        assert error_of(write(tmp_path / "a.json", document)).startswith(expected)
