"""Controls as dense targets: where they land, and which combinations are refused."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from controlmm.controls import (
    ControlFile,
    DenseControls,
    JointControl,
    PathControl,
    PoseControl,
    densify,
    stack_dense,
)
from controlmm.motion.skeleton import KIT


def test_targets_land_at_their_frame_and_joint():
    dense = densify([JointControl("head", [2], [[1.0, None, 3.0]]), PathControl(xz=[[0, 0], [0, 4]])], 5)
    assert dense.targets.shape == (5, 22, 3)
    assert dense.targets[2, 15].tolist() == [1.0, 0.0, 3.0]
    assert dense.mask[2, 15].tolist() == [True, False, True]
    assert dense.targets[:, 0, 2].tolist() == [0, 1, 2, 3, 4]
    assert dense.mask.sum() == 2 + 5 * 2
    assert not dense.targets[~dense.mask].any()


def test_properties():
    dense = densify([JointControl(21, [0], [[0, 1, 0]]), JointControl("pelvis", [3], [[None, 1, None]])], 4)
    assert dense.controlled_joints == (0, 21)
    assert dense.num_frames == 4
    assert not dense.is_empty


def test_no_controls():
    dense = densify([], 8)
    assert dense.is_empty
    assert dense.controlled_joints == ()
    assert dense.mask.shape == (8, 22, 3)


def test_kit_targets_are_in_millimetres():
    dense = densify([JointControl("LW", [1], [[0.1, 0.2, 0.3]])], 2, KIT)
    torch.testing.assert_close(dense.targets[1, 7], torch.tensor([100.0, 200.0, 300.0]))


def test_controls_of_one_joint_may_share_frames_on_other_axes():
    height = JointControl("pelvis", [0, 1], [[None, 0.9, None], [None, 0.8, None]])
    dense = densify([PathControl(xz=[[0, 0], [1, 1]]), height], 2)
    assert dense.targets[:, 0].tolist() == [[0, pytest.approx(0.9), 0], [1, pytest.approx(0.8), 1]]
    assert dense.mask[:, 0].all()


def test_controls_that_agree_to_a_millimetre_pass():
    dense = densify(
        [JointControl("head", [0], [[0, 1.7, 0]]), JointControl("head", [0], [[0, 1.7009, 0]])], 1
    )
    assert dense.targets[0, 15, 1] == pytest.approx(1.7)


def test_contradicting_controls_name_both():
    controls = [
        JointControl("head", [9], [[0, 1, 0]]),
        PathControl(xz=[[0, 0], [0, 2]], frames=[0, 40]),
        PoseControl([40], torch.full((1, 22, 3), 0.5)),
    ]
    expected = (
        r"control 1 \(pelvis path\) and control 2 \(pose\) contradict each other: at frame 40 they want "
        r"pelvis x = 0\.000 m and 0\.500 m\. Remove one or make them agree to 1 mm\."
    )
    with pytest.raises(ValueError, match=expected):
        densify(controls, 60)


def test_a_frame_outside_the_clip_is_refused():
    controls = [PathControl(xz=[[0, 0], [0, 1]])] * 2 + [
        JointControl("right_wrist", [3, 400, 5], [[0, 1, 0]] * 3)
    ]
    expected = (
        r"^control 2 \(right_wrist\) names frame 400, but the clip has 120 frames \(0\.\.119\)\. "
        r"Shorten the control or ask for more seconds\.$"
    )
    with pytest.raises(ValueError, match=expected):
        densify(controls, 120)


def test_the_last_frame_is_inside():
    assert densify([JointControl("head", [119], [[0, 1, 0]])], 120).mask[119].any()
    with pytest.raises(ValueError, match=r"names frame 120, but the clip has 120 frames \(0\.\.119\)"):
        densify([JointControl("head", [120], [[0, 1, 0]])], 120)


def test_a_joint_that_the_skeleton_lacks_names_the_control():
    with pytest.raises(
        ValueError, match=r'^control 0 \(head\): Unknown joint "head"\. The kit skeleton has: root'
    ):
        densify([JointControl("head", [0], [[0, 1, 0]])], 4, KIT)


@pytest.mark.parametrize(
    ("controls", "message"),
    [
        (JointControl("head", [0], [[0, 1, 0]]), "`controls` must be a list of controls, got JointControl"),
        (ControlFile([]), "`controls` must be a list of controls, got ControlFile"),
        ("circle.json", "`controls` must be a list of controls, got str"),
        (
            [{"type": "joint"}],
            r"`controls\[0\]` must be a JointControl, PathControl or PoseControl, got dict\. Read",
        ),
    ],
    ids=["one control", "a file", "a path", "a dict"],
)
def test_what_is_no_list_of_controls_is_refused(controls, message):
    with pytest.raises(TypeError, match=message):
        densify(controls, 4)


@pytest.mark.parametrize("num_frames", [0, -1, 2.0, True])
def test_the_number_of_frames_must_be_a_positive_integer(num_frames):
    with pytest.raises(ValueError, match="`num_frames` must be a positive integer, got"):
        densify([], num_frames)


def test_stacked_clips_are_padded_with_free_frames():
    clips = [
        densify([JointControl("head", [1], [[1, 2, 3]])], 2),
        densify([PathControl(xz=[[0, 0], [0, 4]])], 5),
    ]
    targets, mask = stack_dense(clips)
    assert targets.shape == mask.shape == (2, 5, 22, 3)
    for row, clip in enumerate(clips):
        assert torch.equal(targets[row, : clip.num_frames], clip.targets)
        assert torch.equal(mask[row, : clip.num_frames], clip.mask)
    assert not mask[0, 2:].any()
    assert not targets[0, 2:].any()


def test_clips_that_do_not_stack_are_refused():
    with pytest.raises(ValueError, match=r"`clips` is empty\. Pass at least one DenseControls"):
        stack_dense([])
    with pytest.raises(ValueError, match=r"`clips` must have one number of joints, got \[21, 22\]"):
        stack_dense([densify([], 2), densify([], 2, KIT)])


@settings(max_examples=30, deadline=None)
@given(
    order=st.permutations(range(4)),
    frames=st.lists(st.integers(0, 19), min_size=1, max_size=8, unique=True),
)
def test_the_order_of_controls_that_agree_changes_nothing(order, frames):
    controls = [
        JointControl("head", frames, [[frame, 1.7, 0] for frame in frames]),
        JointControl("left_wrist", frames, [[0, None, frame] for frame in frames]),
        PathControl(xz=[[0, 0], [2, 3]]),
        PoseControl(frames[:1], [[[None, 0.1, None]] * 2], joints=["left_foot", "right_foot"]),
    ]
    one, other = densify(controls, 20), densify([controls[index] for index in order], 20)
    assert isinstance(one, DenseControls)
    assert torch.equal(one.targets, other.targets)
    assert torch.equal(one.mask, other.mask)
