from __future__ import annotations

import logging
import re

import numpy as np
import pytest
import torch

from controlmm.io.bvh import BvhFormat
from controlmm.io.bvh_parser import bvh_positions, parse_bvh
from controlmm.motion.motion import Motion
from controlmm.motion.rotation_fit import fit_rotations
from controlmm.motion.skeleton import HUMANML3D, KIT

ONE_FILE_DIGIT = 1e-6  # metres; six digits of centimetres and degrees along eight bones, read back as float32
INDEPENDENT_READER = 1e-4  # metres; bvhio calculates in float32 centimetres


@pytest.fixture
def path(tmp_path):
    return tmp_path / "walk.bvh"


@pytest.fixture
def text(walking, path):
    BvhFormat.save(walking, path)
    return path.read_text()


def assert_independent_reader_agrees(path, motion):
    bvhio = pytest.importorskip("bvhio")
    fitted = fit_rotations(motion.joints, motion.skeleton).joints.numpy()
    root = bvhio.readAsHierarchy(str(path))
    layout = [joint for joint, _, _ in root.layout()]
    assert {joint.Name for joint in layout} == set(motion.skeleton.joint_names)
    for frame in range(motion.num_frames):
        root.loadPose(frame)
        for joint in layout:
            expected = fitted[frame, motion.skeleton.joint_index(joint.Name)]
            np.testing.assert_allclose(np.array(joint.PositionWorld) / 100, expected, atol=INDEPENDENT_READER)


def test_independent_reader_finds_the_fitted_joints_at_every_frame(walking, text, path):
    assert_independent_reader_agrees(path, walking)


def test_independent_reader_finds_the_fitted_joints_of_real_clips(real_clips, path):
    for joints in real_clips:
        motion = Motion(joints=joints.float())
        BvhFormat.save(motion, path)
        assert_independent_reader_agrees(path, motion)


def test_written_joints_are_read_back(walking, text, path):
    loaded = BvhFormat.load(path)
    assert loaded.skeleton is HUMANML3D
    torch.testing.assert_close(loaded.joints, walking.joints, rtol=0, atol=4 * ONE_FILE_DIGIT)


def test_root_keeps_its_motion_exactly(walking, text):
    rows = np.array([line.split() for line in text.splitlines()[-walking.num_frames :]], dtype=np.float64)
    np.testing.assert_allclose(rows[:, :3] / 100, walking.joints[:, 0].numpy(), atol=ONE_FILE_DIGIT)


def test_file_states_exact_frame_time_and_channels(walking, text):
    lines = [line.strip() for line in text.splitlines()]
    assert lines[0] == "HIERARCHY"
    assert f"Frames: {walking.num_frames}" in lines
    assert float(next(line for line in lines if line.startswith("Frame Time:")).split()[-1]) == 0.05
    assert lines[4] == "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    assert lines.count("CHANNELS 3 Zrotation Xrotation Yrotation") == 21
    assert lines.count("End Site") == 5


def test_joints_are_listed_depth_first(text):
    names = re.findall(r"(?:ROOT|JOINT) (\S+)", text)
    assert names[:6] == ["pelvis", "left_hip", "left_knee", "left_ankle", "left_foot", "right_hip"]
    assert (
        names.index("head")
        < names.index("left_collar")
        < names.index("left_wrist")
        < names.index("right_collar")
    )


def test_end_sites_continue_their_bones(text):
    sites = re.findall(
        r"JOINT (\w+)\s*\{\s*OFFSET.*\s*CHANNELS.*\s*End Site\s*\{\s*OFFSET (\S+) (\S+) (\S+)", text
    )
    tips = {name: np.array([float(x), float(y), float(z)]) for name, x, y, z in sites}
    assert set(tips) == {"left_foot", "right_foot", "head", "left_wrist", "right_wrist"}
    assert tips["head"][1] > 5
    assert tips["left_wrist"][0] > 5
    assert tips["right_wrist"][0] < -5
    assert tips["left_foot"][2] > 3


def test_metres_are_written_and_read_when_asked(walking, path):
    BvhFormat.save(walking, path, unit="m")
    loaded = BvhFormat.load(path, unit="m")
    torch.testing.assert_close(loaded.joints, walking.joints, rtol=0, atol=2e-5)  # six digits of metres
    with pytest.raises(
        ValueError, match=r"legs are 0.00\d+ m long if the unit is 'cm'. Pass the right `unit`"
    ):
        BvhFormat.load(path)


def test_fitting_error_goes_to_the_log(walking, path, caplog):
    with caplog.at_level(logging.INFO, logger="controlmm"):
        BvhFormat.save(walking, path)
    assert re.search(r"rigid bones lie \S+ m from the given joints on average, \S+ m at most", caplog.text)


def test_kit_motion_round_trips_in_millimetres(path):
    fitted = fit_rotations(torch.randn(6, 21, 3, generator=torch.Generator().manual_seed(0)) * 400, KIT)
    motion = Motion(joints=fitted.joints.float(), skeleton=KIT)
    BvhFormat.save(motion, path)
    loaded = BvhFormat.load(path)
    assert loaded.skeleton is KIT
    assert loaded.fps == 12.5
    refitted = fit_rotations(motion.joints, KIT)
    torch.testing.assert_close(loaded.joints.double(), refitted.joints, rtol=0, atol=1e-2)  # 0.01 mm


def test_other_frame_rates_are_refused_or_resampled(walking, text, path):
    path.write_text(text.replace("Frame Time: 0.05000000", "Frame Time: 0.0333333"))
    with pytest.raises(
        ValueError, match=r"frame time is 0.0333333 s, expected 0.05 s .*Pass `resample=True`"
    ):
        BvhFormat.load(path)
    loaded = BvhFormat.load(path, resample=True)
    assert loaded.num_frames == 40  # 59 steps of 1/30 s hold 39 steps of 1/20 s
    torch.testing.assert_close(loaded.joints[2], walking.joints[3], rtol=0, atol=1e-4)
    halfway = (walking.joints[1] + walking.joints[2]) / 2
    torch.testing.assert_close(loaded.joints[1], halfway, rtol=0, atol=1e-4)


def test_joints_beyond_the_skeleton_are_left_out(walking, text, path):
    finger = (
        "JOINT left_thumb\n{\nOFFSET 1 2 3\nCHANNELS 3 Xrotation Yrotation Zrotation\n"
        "End Site\n{\nOFFSET 1 0 0\n}\n}\n"
    )
    head, motion = text.split("MOTION")
    lines = head.splitlines()
    at = next(i for i, line in enumerate(lines) if "JOINT left_knee" in line)
    channels_before = sum(int(line.split()[1]) for line in lines[:at] if "CHANNELS" in line)
    rows = motion.strip().splitlines()
    for i in range(2, len(rows)):
        words = rows[i].split()
        rows[i] = " ".join([*words[:channels_before], "10", "20", "30", *words[channels_before:]])
    path.write_text("\n".join([*lines[:at], finger, *lines[at:]]) + "\nMOTION\n" + "\n".join(rows))
    torch.testing.assert_close(BvhFormat.load(path).joints, walking.joints, rtol=0, atol=4 * ONE_FILE_DIGIT)


def test_other_rotation_orders_are_read(walking):
    text = (
        "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\n"
        "CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation\n"
        "JOINT b\n{\nOFFSET 1 0 0\nCHANNELS 3 Xrotation Yrotation Zrotation\n"
        "End Site\n{\nOFFSET 0 1 0\n}\n}\n}\n"
        "MOTION\nFrames: 1\nFrame Time: 0.05\n5 6 7 90 0 90 0 0 0\n"
    )
    # Z acts first: x -> y, and Y leaves y alone.
    np.testing.assert_allclose(bvh_positions(parse_bvh(text))[0], [[5, 6, 7], [5, 7, 7]], atol=1e-9)


def test_unknown_names_are_listed(text, path):
    path.write_text(text.replace("left_wrist", "LeftHand").replace("head", "Head"))
    with pytest.raises(ValueError, match=r"2 of its 22 joints are missing \(head, left_wrist\)"):
        BvhFormat.load(path)


DAMAGE = {
    "cut in the hierarchy": (lambda text: text[:400], r"line \d+: the file ends where"),
    "cut in the motion": (lambda text: text[: len(text) - 3000], r"line \d+: (expected|the file ends where)"),
    "not a BVH": (lambda _: "hello\n", r"line 1: expected 'HIERARCHY', found 'hello'"),
    "empty": (lambda _: "", r"line 1: the file ends where 'HIERARCHY' should be"),
    "binary": (lambda _: "\x00\x01\x02PNG\n", r"line 1: expected 'HIERARCHY'"),
    "no numbers": (
        lambda text: text.replace("OFFSET 0.000000", "OFFSET zero", 1),
        r"line 4: expected 3 numbers",
    ),
    "NaN": (
        lambda text: text.replace("OFFSET 0.000000", "OFFSET nan", 1),
        r"line 4: expected 3 finite numbers",
    ),
    "more frames than rows": (
        lambda text: text.replace("Frames: 60", "Frames: 999999999"),
        r"frame 61 of 999999999",
    ),
    "no frames": (
        lambda text: text.replace("Frames: 60", "Frames: 0"),
        r"expected at least one frame, found 0",
    ),
    "no time": (lambda text: text.replace("Time: 0.05", "Time: -0.05"), r"expected a positive frame time"),
    "short row": (lambda text: text.rsplit(" ", 1)[0], r"line \d+: expected 69 finite numbers, found 68"),
    "odd channel": (
        lambda text: text.replace("Zrotation", "Wrotation", 1),
        r"line 5: expected 6 different channels",
    ),
    "two rotations": (
        lambda text: text.replace(
            "CHANNELS 3 Zrotation Xrotation Yrotation", "CHANNELS 2 Zrotation Xrotation", 1
        ),
        r"expected three rotation channels or none, found 2",
    ),
    "stray word": (
        lambda text: text.replace("End Site", "Fin Site", 1),
        r"expected a joint, CHANNELS, OFFSET or",
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_files_raise_one_line_with_the_line_number(name, text, path):
    damage, message = DAMAGE[name]
    path.write_text(damage(text))
    with pytest.raises(ValueError, match=message) as error:
        BvhFormat.load(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_unknown_units_are_refused_and_leave_no_file(walking, path):
    with pytest.raises(ValueError, match="`unit` must be 'cm' or 'm', got 'inch'"):
        BvhFormat.save(walking, path, unit="inch")
    assert list(path.parent.iterdir()) == []
