"""The JSON form of controls: round trips, and the one line that each mistake gets."""

from __future__ import annotations

import copy
import json

import pytest
import torch
from control_files import error_of, write
from hypothesis import given, settings
from hypothesis import strategies as st

from controlmm.controls import (
    ControlFile,
    JointControl,
    PathControl,
    PoseControl,
    densify,
    load_controls,
    save_controls,
)

DOCUMENT = {
    "version": 1,
    "units": "m",
    "up": "y",
    "fps": 20,
    "prompt": "a person walks",
    "seconds": 3,
    "controls": [
        {"type": "path", "xz": [[0, 0], [0, 2]]},
        {"type": "joint", "joint": "head", "frames": [0, 5], "positions": [[0, 1.7, 0], [0, None, 0.5]]},
        {"type": "pose", "joints": ["left_foot"], "frames": [9], "positions": [[[0.1, 0, 0]]]},
    ],
}


def changed(place, value):
    """DOCUMENT with the value at ``place`` (keys and indices) replaced, or taken out if it is ``...``."""
    document = copy.deepcopy(DOCUMENT)
    parent = document
    for key in place[:-1]:
        parent = parent[key]
    if value is ...:
        del parent[place[-1]]
    else:
        parent[place[-1]] = value
    return document


def complaint_about(path):
    try:
        load_controls(path)
    except ValueError as error:
        return str(error)
    return ""


def test_a_document_is_read(tmp_path):
    file = load_controls(write(tmp_path / "a.json", DOCUMENT))
    assert (file.seconds, file.text) == (3, "a person walks")
    path, head, pose = file.controls
    assert isinstance(path, PathControl)
    assert (path.joint, path.frames, path.xz.tolist()) == ("pelvis", None, [[0, 0], [0, 2]])
    assert isinstance(head, JointControl)
    assert head.mask.tolist() == [[True, True, True], [True, False, True]]
    assert isinstance(pose, PoseControl)
    assert pose.joints == ("left_foot",)


def test_prompt_and_seconds_may_be_left_out(tmp_path):
    document = {key: DOCUMENT[key] for key in ("version", "units", "up", "fps", "controls")}
    file = load_controls(write(tmp_path / "a.json", document))
    assert (file.seconds, file.text) == (None, None)


def test_a_file_with_a_byte_order_mark_is_read(tmp_path):
    path = tmp_path / "a.JSON"
    path.write_text(json.dumps(DOCUMENT), encoding="utf-8-sig")
    assert len(load_controls(path).controls) == 3


POINTS = st.lists(
    st.lists(st.one_of(st.none(), st.floats(-50, 50, width=32)), min_size=3, max_size=3).filter(any),
    min_size=1,
    max_size=5,
)


@settings(max_examples=40, deadline=None)
@given(
    points=POINTS,
    joint=st.sampled_from(["pelvis", "head", 20]),
    text=st.one_of(st.none(), st.text(max_size=20)),
)
def test_what_is_saved_is_loaded_bit_by_bit(tmp_path_factory, points, joint, text):
    frames = range(len(points))
    controls = [
        JointControl(joint, frames, points),
        PathControl("left_foot", xz=[[point[0] or 0.0, point[2] or 0.0] for point in points], frames=frames),
        PoseControl(frames, [[point, [1.5, None, 0.1]] for point in points], joints=["right_foot", 18]),
    ]
    path = tmp_path_factory.mktemp("controls") / "deep" / "saved.json"
    assert save_controls(ControlFile(controls, seconds=2.5, text=text), path) == path
    loaded = load_controls(path)
    assert (loaded.seconds, loaded.text) == (2.5, text)
    for one, other in zip(controls, loaded.controls, strict=True):
        before, after = densify([one], 5), densify([other], 5)
        assert torch.equal(before.targets, after.targets)
        assert torch.equal(before.mask, after.mask)
        assert one.label == other.label


def test_a_path_over_the_whole_clip_stays_one(tmp_path):
    path = save_controls(ControlFile([PathControl(xz=[[0, 0], [0, 1]])]), tmp_path / "a.json")
    assert load_controls(path).controls[0].frames is None
    assert "frames" not in json.loads(path.read_text(encoding="utf-8"))["controls"][0]


def test_no_controls_are_saved_and_loaded(tmp_path):
    assert load_controls(save_controls(ControlFile([]), tmp_path / "a.json")).controls == ()


MISTAKES = {
    "no header": (["units"], ..., 'missing key "units". Needed keys: version, units, up, fps, controls.'),
    "no controls": (["controls"], ..., 'missing key "controls".'),
    "a later version": (["version"], 2, "version: must be 1, got 2."),
    "version true": (["version"], True, "version: must be 1, got true."),
    "other units": (["units"], "cm", 'units: must be "m", got "cm".'),
    "other axis up": (["up"], "z", 'up: must be "y", got "z".'),
    "other fps": (["fps"], 30, "fps: must be 20, got 30."),
    "unknown key": (
        ["gravity"], [],
        'unknown key "gravity". Known keys: controls, fps, obstacles, prompt, seconds, timeline, '
        "units, up, version.",
    ),
    "misspelt key": (["control"], [], 'unknown key "control". Did you mean "controls"?'),
    "prompt no text": (["prompt"], 5, "prompt: must be a string, got 5."),
    "seconds text": (["seconds"], "6", 'seconds: must be a number, got "6".'),
    "seconds NaN": (["seconds"], float("nan"), "seconds: must be a finite number, got NaN."),
    "seconds negative": (["seconds"], -1, "`seconds` must be positive and finite, got -1."),
    "controls no list": (["controls"], {}, "controls: must be a list, got {}."),
    "control no object": (["controls", 1], 7, "controls[1]: must be an object, got 7."),
    "no type": (
        ["controls", 1,
        "type"], ..., 'controls[1]: missing key "type". It must be one of: joint, path, pose.',
    ),
    "unknown type": (
        ["controls", 1,
        "type"], "box", 'controls[1].type: must be one of joint, path, pose, got "box".',
    ),
    "type a list": (
        ["controls", 1,
        "type"], [], "controls[1].type: must be one of joint, path, pose, got [].",
    ),
    "no joint": (
        ["controls", 1,
        "joint"], ..., 'controls[1]: missing key "joint". Needed keys: joint, frames, positions.',
    ),
    "unknown key in control": (
        ["controls", 1, "postions"], [],
        'controls[1]: unknown key "postions". Did you mean "positions"? Known keys: frames, joint, ',
    ),
    "unknown joint": (
        ["controls", 1,
        "joint"], "tail", 'controls[1]: Unknown joint "tail". The humanml3d skeleton has:',
    ),
    "joint a float": (
        ["controls", 1,
        "joint"], 1.0, "controls[1].joint: must be a joint's name or index, got 1.0.",
    ),
    "frames a number": (
        ["controls", 1,
        "frames"], 3, "controls[1].frames: must be a list of frame numbers, got 3.",
    ),
    "frame a float": (
        ["controls", 1,
        "frames"], [0, 5.0], "controls[1].frames[1]: must be a whole number, got 5.0.",
    ),
    "frame negative": (
        ["controls", 1,
        "frames"], [0, -5], "controls[1]: `frames[1]` must not be negative, got -5.",
    ),
    "frames doubled": (["controls", 1, "frames"], [4, 4], "controls[1]: `frames` names frame 4 twice."),
    "too few points": (
        ["controls", 1,
        "frames"], [0, 1, 2], "controls[1]: `positions` must have shape (len(frames), 3) = (3, 3)",
    ),
    "point too short": (
        ["controls", 1, "positions", 1], [0, 1],
        "controls[1].positions[1]: must be a list of 3 numbers, got 2: [0, 1].",
    ),
    "point no list": (
        ["controls", 1,
        "positions", 1], 4, "controls[1].positions[1]: must be a list of 3 numbers, got 4.",
    ),
    "point with text": (
        ["controls", 1, "positions", 1], [0, "1", 0], 'controls[1].positions[1]: must be a number, got "1".',
    ),
    "point with true": (
        ["controls", 1,
        "positions", 1], [0, True, 0], "controls[1].positions[1]: must be a number, got true.",
    ),
    "NaN": (
        ["controls", 1, "positions", 1], [0, float("nan"), 0],
        "controls[1].positions[1]: must be a finite number, got NaN.",
    ),
    "infinity": (
        ["controls", 1, "positions", 1], [0, float("inf"), 0],
        "controls[1].positions[1]: must be a finite number, got Infinity.",
    ),
    "all axes free": (
        ["controls", 1,
        "positions", 1], [None] * 3, "controls[1]: Every axis is free at frame 5.",
    ),
    "positions no list": (
        ["controls", 1,
        "positions"], "x", 'controls[1].positions: must be a list of points, got "x".',
    ),
    "xz of three": (
        ["controls", 0,
        "xz", 1], [0, 0, 0], "controls[0].xz[1]: must be a list of 2 numbers, got 3: [0, 0, 0].",
    ),
    "xz null": (["controls", 0, "xz", 1], [0, None], "controls[0]: `xz` must not hold None."),
    "pose joints text": (
        ["controls", 2,
        "joints"], "head", 'controls[2].joints: must be a list of joints, got "head".',
    ),
    "pose joint a float": (
        ["controls", 2, "joints"], [1.5], "controls[2].joints[0]: must be a joint's name or index, got 1.5.",
    ),
    "pose with NaN": (
        ["controls", 2, "positions", 0, 0], [0, float("nan"), 0],
        "controls[2].positions[0][0]: must be a finite number, got NaN.",
    ),
    "pose flat": (
        ["controls", 2,
        "positions", 0], 5, "controls[2].positions[0]: must be a list of points, got 5.",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("place", "value", "expected"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_named_with_its_place(tmp_path, place, value, expected):
    assert error_of(write(tmp_path / "a.json", changed(place, value))).startswith(expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('{\n  "version": 1,\n}', "broken JSON at line 3, column 1: "),
        ("", "broken JSON at line 1, column 1: "),
        ('{"version": 1, "version": 1}', 'the key "version" is there twice in one object.'),
        ("[1]", "must be an object, got [1]."),
        ("[" * 100_000, "broken JSON: the brackets are nested too deeply."),
        (json.dumps(DOCUMENT)[:-30], "broken JSON at line 1, column "),
    ],
    ids=["comma", "empty", "double key", "list", "deep", "cut off"],
)
def test_broken_json_is_named_with_its_line(tmp_path, text, expected):
    assert error_of(write(tmp_path / "a.json", text)).startswith(expected)


def test_bytes_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "a.json").write_bytes(b"\xff\xfe{}")
    assert error_of(tmp_path / "a.json") == "not a text file in UTF-8 (byte 0)."


def test_missing_file_folder_and_suffix(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"^No control file at .*nothing\.json\.$"):
        load_controls(tmp_path / "nothing.json")
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(FileNotFoundError, match="No control file at"):
        load_controls(tmp_path / "folder.json")
    with pytest.raises(ValueError, match=r"must end in \.json, \.csv, \.npy, \.npz, got '\.yaml'"):
        load_controls(tmp_path / "a.yaml")
    with pytest.raises(ValueError, match=r"controls are written as \.json, got '\.csv'"):
        save_controls(ControlFile([]), tmp_path / "a.csv")


def test_a_control_without_a_json_form_is_refused(tmp_path):
    with pytest.raises(
        TypeError, match=r"A dict has no JSON form\. Use JointControl, PathControl or PoseControl"
    ):
        save_controls(ControlFile([{}]), tmp_path / "a.json")


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_document_with_any_value_changed_loads_or_says_why(tmp_path_factory, data):
    junk = st.one_of(
        st.none(), st.booleans(), st.integers(-3, 2**70), st.floats(), st.text(max_size=3),
        st.lists(st.integers(0, 2), max_size=3), st.just({}),
    )  # fmt: skip
    document, place = copy.deepcopy(DOCUMENT), []
    node = document
    while isinstance(node, (dict, list)) and node and (not place or data.draw(st.booleans())):
        key = data.draw(st.sampled_from(list(node) if isinstance(node, dict) else range(len(node))))
        place.append(key)
        node = node[key]
    path = write(tmp_path_factory.mktemp("junk") / "a.json", changed(place, data.draw(junk)))
    complaint = complaint_about(path)
    assert not complaint or complaint.startswith(f"{path}: ")
    assert "\n" not in complaint
