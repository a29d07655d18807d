"""Joint, path and pose controls: what they accept, how they normalise it, what they say about bad input."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from controlmm.controls import Control, JointControl, PathControl, PoseControl
from controlmm.motion.skeleton import HUMANML3D, KIT

POINT = [0.0, 0.9, 0.0]


@pytest.mark.parametrize(
    "frames",
    [[3, 1], (3, 1), range(3, 0, -2), np.array([3, 1], dtype=np.int32), torch.tensor([3, 1])],
    ids=repr,
)
def test_frames_of_any_sequence_keep_their_order(frames):
    control = JointControl("pelvis", frames, [[0, 1, 2], [3, 4, 5]])
    assert control.frames.dtype == torch.int64
    assert control.frames.tolist() == [3, 1]


@pytest.mark.parametrize(
    "positions",
    [
        [[0, 1, 2], [3, 4, 5]],
        np.arange(6).reshape(2, 3),
        torch.arange(6.0, dtype=torch.float64, requires_grad=True).reshape(2, 3),
        [torch.tensor([0.0, 1.0, 2.0]), torch.tensor([3.0, 4.0, 5.0])],
        [np.array([0.0, 1.0, 2.0]), np.array([3.0, 4.0, 5.0])],
    ],
    ids=["list", "integers", "float64 with gradient", "list of tensors", "list of arrays"],
)
def test_positions_become_float32(positions):
    control = JointControl("pelvis", [0, 1], positions)
    assert control.positions.dtype == torch.float32
    assert control.positions.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert control.mask.all()


def test_none_leaves_an_axis_free():
    control = JointControl("head", [0, 5], [[1.0, None, 2.0], [None, 1.5, None]])
    assert control.mask.tolist() == [[True, False, True], [False, True, False]]
    assert control.positions.tolist() == [[1.0, 0.0, 2.0], [0.0, 1.5, 0.0]]


def test_controls_are_frozen_and_fulfil_the_protocol():
    for control in (
        JointControl(0, [0], [POINT]),
        PathControl(xz=[[0, 0], [0, 1]]),
        PoseControl([0], torch.zeros(1, 22, 3)),
    ):
        assert isinstance(control, Control)
        with pytest.raises(dataclasses.FrozenInstanceError):
            control.frames = None


@pytest.mark.parametrize(
    ("control", "label"),
    [
        (JointControl("head", [0], [POINT]), "head"),
        (JointControl(15, [0], [POINT]), "joint 15"),
        (PathControl(xz=[[0, 0], [0, 1]]), "pelvis path"),
        (PathControl(15, xz=[[0, 0], [0, 1]]), "joint 15 path"),
        (PoseControl([0], torch.zeros(1, 22, 3)), "pose"),
        (PoseControl([0], torch.zeros(1, 2, 3), joints=["head", 20]), "pose of head, 20"),
    ],
    ids=str,
)
def test_labels(control, label):
    assert control.label == label


# --- joints ------------------------------------------------------------


def test_an_unknown_joint_lists_the_skeleton():
    with pytest.raises(
        ValueError, match=r'^Unknown joint "tail"\. The humanml3d skeleton has: pelvis, left_hip, '
    ):
        JointControl("tail", [0], [POINT])


@pytest.mark.parametrize("name", ["right_wrsit", "Right Wrist", "RightWrist"])
def test_a_misspelt_joint_gets_a_suggestion(name):
    with pytest.raises(
        ValueError, match=rf'^Unknown joint "{name}"\. Did you mean "right_wrist"\? The humanml3d'
    ):
        JointControl(name, [0], [POINT])


@pytest.mark.parametrize(
    ("name", "ours"),
    [
        ("left_hand", "left_wrist"),
        ("LeftHand", "left_wrist"),
        ("right toe", "right_foot"),
        ("hips", "pelvis"),
    ],
)
def test_other_skeletons_words_get_a_suggestion(name, ours):
    with pytest.raises(ValueError, match=rf'^Unknown joint "{name}"\. Did you mean "{ours}"\?'):
        JointControl(name, [0], [POINT])


def test_a_joint_of_another_skeleton_is_found_out_when_the_clip_is_made():
    control = JointControl("LW", [0], [POINT])
    assert control.sample(1, KIT).joints.tolist() == [7]
    with pytest.raises(ValueError, match='Unknown joint "LW"'):
        control.sample(1, HUMANML3D)


def test_bad_joint_index_and_type():
    with pytest.raises(ValueError, match=r"Joint index must be in 0\.\.21, got 22"):
        JointControl(22, [0], [POINT])
    with pytest.raises(TypeError, match=r"`joint` must be a name such as 'pelvis' or an index, got float"):
        JointControl(1.0, [0], [POINT])
    with pytest.raises(TypeError, match="got bool"):
        PathControl(True, xz=[[0, 0], [0, 1]])


# --- frames ------------------------------------------------------------


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([0, -3], r"`frames\[1\]` must not be negative, got -3\. The first frame is 0\."),
        ([0, 2.5], r"`frames\[1\]` must be an integer, got 2\.5\. Frames count from 0 at 20 fps\."),
        ([0, True], r"`frames\[1\]` must be an integer, got True"),
        ([0, "1"], r"`frames\[1\]` must be an integer, got '1'"),
        (np.array([0.0, 1.0]), r"`frames\[0\]` must be an integer, got 0\.0"),
        ([7, 7], r"`frames` names frame 7 twice\. Give one target for each frame\."),
        ([], r"`frames` is empty\. Name at least one frame\."),
    ],
    ids=str,
)
def test_bad_frames_are_named(frames, message):
    with pytest.raises(ValueError, match=message):
        JointControl("pelvis", frames, [POINT, POINT])


@pytest.mark.parametrize("frames", [3, "12", None])
def test_frames_must_be_a_sequence(frames):
    with pytest.raises(TypeError, match="`frames` must be a sequence of frame numbers, got"):
        JointControl("pelvis", frames, [POINT])


# --- positions ------------------------------------------------------------


@pytest.mark.parametrize("positions", [[POINT], POINT, [[0, 1], [0, 1]], []], ids=str)
def test_positions_of_another_shape_are_refused(positions):
    with pytest.raises(
        ValueError, match=r"`positions` must have shape \(len\(frames\), 3\) = \(2, 3\), got \("
    ):
        JointControl("pelvis", [0, 1], positions)


@pytest.mark.parametrize(
    "positions", [[[0, 1, 2], [3, 4]], [["a", 0, 0]], [["1", "2", "3"]], [[{}, 0, 0]]], ids=str
)
def test_positions_that_are_no_numbers_are_refused(positions):
    with pytest.raises(ValueError, match=r"`positions` must be a rectangular array of numbers \(or None"):
        JointControl("pelvis", range(len(positions)), positions)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
def test_targets_that_are_not_finite_name_the_frame(value):
    with pytest.raises(
        ValueError, match=r"`positions\[1\]` \(frame 80\) must be finite, got \(0, .*, 2\)\. Leave"
    ):
        JointControl("pelvis", [40, 80], [POINT, [0.0, value, 2.0]])


def test_a_frame_with_every_axis_free_is_refused():
    with pytest.raises(ValueError, match=r"Every axis is free at frame 9\. Leave that frame out\."):
        JointControl("pelvis", [4, 9], [POINT, [None, None, None]])


# --- paths ------------------------------------------------------------


def test_a_path_without_frames_is_followed_at_constant_speed():
    corner = PathControl("pelvis", xz=[[0, 0], [0, 1], [3, 1]])  # 4 m
    samples = corner.sample(5, HUMANML3D)
    assert corner.length == pytest.approx(4.0)
    assert samples.frames.tolist() == [0, 1, 2, 3, 4]
    expected = [[0, 0, 0], [0, 0, 1], [1, 0, 1], [2, 0, 1], [3, 0, 1]]
    torch.testing.assert_close(samples.positions[:, 0], torch.tensor(expected).float())
    assert samples.mask[:, 0].tolist() == [[True, False, True]] * 5


def test_a_path_with_repeated_points_or_no_length():
    repeated = PathControl(xz=[[0, 0], [0, 0], [0, 2], [0, 2]]).sample(3, HUMANML3D)
    assert repeated.positions[:, 0, 2].tolist() == [0, 1, 2]
    standing = PathControl(xz=[[1, 2], [1, 2]]).sample(4, HUMANML3D)
    assert standing.positions[:, 0].tolist() == [[1, 0, 2]] * 4


def test_a_path_in_a_clip_of_one_frame_is_its_start():
    assert PathControl(xz=[[1, 2], [3, 4]]).sample(1, HUMANML3D).positions.tolist() == [[[1, 0, 2]]]


def test_a_path_with_frames_holds_only_these():
    samples = PathControl("head", xz=[[0, 0], [1, 2]], frames=[10, 30]).sample(60, HUMANML3D)
    assert samples.frames.tolist() == [10, 30]
    assert samples.joints.tolist() == [15]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"xz": [[0, 0, 0]]},
            r"`xz` must have shape \(N, 2\), got \(1, 3\)\. Pass x and z of each point in metres",
        ),
        ({"xz": None}, r"`xz` must have shape \(N, 2\), got \(\)"),
        ({"xz": [[0, 0]]}, r"`xz` needs at least 2 points without `frames`, got 1"),
        (
            {"xz": [[0, 0]], "frames": [0, 1]},
            r"`xz` must hold one point for each of the 2 `frames`, got 1 points",
        ),
        (
            {"xz": [[0, 0], [0, None]]},
            r"`xz` must not hold None\. To hold only x or only z use a JointControl",
        ),
        ({"xz": [[0, 0], [0, math.nan]]}, r"`xz\[1\]` must be finite, got \(0, nan\)"),
        ({"xz": [[0, 0], [0, math.nan]], "frames": [0, 8]}, r"`xz\[1\]` \(frame 8\) must be finite"),
    ],
    ids=str,
)
def test_bad_paths_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        PathControl(**arguments)


# --- poses ------------------------------------------------------------


def test_a_whole_pose_holds_every_joint():
    poses = torch.randn(2, 22, 3, generator=torch.Generator().manual_seed(0))
    samples = PoseControl([0, 39], poses).sample(40, HUMANML3D)
    assert samples.joints.tolist() == list(range(22))
    assert torch.equal(samples.positions, poses)


def test_joints_of_a_pose_are_taken_from_whole_poses_or_given_alone():
    poses = torch.randn(2, 22, 3, generator=torch.Generator().manual_seed(0))
    joints = ["right_wrist", "head"]
    from_whole = PoseControl([0, 39], poses, joints=joints).sample(40, HUMANML3D)
    alone = PoseControl([0, 39], poses[:, [21, 15]], joints=joints).sample(40, HUMANML3D)
    assert from_whole.joints.tolist() == alone.joints.tolist() == [21, 15]
    assert torch.equal(from_whole.positions, alone.positions)


def test_joints_that_are_not_held_may_be_nan():
    poses = torch.full((1, 22, 3), math.nan)
    poses[:, 15] = 1.0
    assert PoseControl([0], poses, joints=["head"]).positions.tolist() == [[[1, 1, 1]]]


@pytest.mark.parametrize(
    ("positions", "joints", "error", "message"),
    [
        (
            torch.zeros(1, 20, 3),
            None,
            ValueError,
            r"shape \(len\(frames\), 22, 3\) with len\(frames\) = 1, got \(1, 20",
        ),
        (torch.zeros(2, 22, 3), None, ValueError, r"len\(frames\) = 1, got \(2, 22, 3\)"),
        (torch.zeros(1, 3, 3), ["head"], ValueError, r"22 or len\(joints\) = 1, 3\) .* got \(1, 3, 3\)"),
        (torch.zeros(1, 22, 3), ["tail"], ValueError, 'Unknown joint "tail"'),
        (torch.zeros(1, 22, 3), ["head", "head"], ValueError, "`joints` names 'head' twice"),
        (torch.zeros(1, 22, 3), [], ValueError, "`joints` is empty. Name at least one joint, or pass None"),
        (
            torch.zeros(1, 22, 3),
            "head",
            TypeError,
            r"`joints` must be a sequence of joints, got 'head'\. Pass \['head'\]",
        ),
        (
            torch.full((1, 22, 3), math.nan),
            None,
            ValueError,
            r"`positions\[0\]` \(frame 5\) must be finite, got .*, \.\.\.",
        ),
    ],
    ids=str,
)
def test_bad_poses_are_refused(positions, joints, error, message):
    with pytest.raises(error, match=message):
        PoseControl([5], positions, joints=joints)


def test_a_pose_of_another_skeleton_is_refused_when_the_clip_is_made():
    with pytest.raises(
        ValueError, match=r"The pose has 21 joints, but the humanml3d skeleton has 22\. Name the joints"
    ):
        PoseControl([0], torch.zeros(1, 21, 3)).sample(1, HUMANML3D)


def test_a_name_and_an_index_for_one_joint_are_refused():
    with pytest.raises(ValueError, match="`joints` names head twice"):
        PoseControl([0], torch.zeros(1, 2, 3), joints=["head", 15]).sample(1, HUMANML3D)
