from __future__ import annotations

import numpy as np
import pytest
import torch

from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import KIT
from controlmm.viewer.camera import Camera
from controlmm.viewer.palette import paler
from controlmm.viewer.pose_strip import shown_frames
from controlmm.viewer.scene import scene_of
from controlmm.viewer.stick_figure import joint_colors


def test_free_heights_are_drawn_where_the_joint_is(controlled_walking):
    scene = scene_of(controlled_walking)
    np.testing.assert_array_equal(scene.targets[:, 0, 1], scene.joints[:, 0, 1])
    assert scene.controlled_joints() == [0, 21]


def test_control_error_is_the_mean_distance_over_targets(controlled_walking):
    # 60 pelvis targets are met, three wrist targets are missed by 3 cm.
    assert scene_of(controlled_walking).control_error() == pytest.approx(3 * 0.03 / 63, rel=1e-4)


def test_motion_without_targets_has_no_control_error(walking):
    assert scene_of(walking).control_error() is None


def test_targets_passed_go_before_those_of_the_motion(controlled_walking):
    mask = torch.zeros(60, 22, dtype=torch.bool)
    mask[5, 15] = True
    scene = scene_of(controlled_walking, targets=controlled_walking.joints + 0.1, mask=mask)
    assert scene.controlled_joints() == [15]
    assert scene.control_error() == pytest.approx(0.1 * 3**0.5, rel=1e-5)


def test_millimetres_become_metres():
    joints = torch.full((4, 21, 3), 500.0)
    mask = torch.ones(4, 21, 3, dtype=torch.bool)
    scene = scene_of(Motion(joints=joints, skeleton=KIT), targets=joints + 30, mask=mask)
    assert scene.joints.max() == pytest.approx(0.5)
    assert scene.control_error() == pytest.approx(0.03 * 3**0.5)


@pytest.mark.parametrize(
    ("targets", "mask", "message"),
    [
        (np.zeros((60, 22, 3)), None, "`targets` and `mask` belong together"),
        (np.zeros((3, 22, 3)), np.ones((60, 22), bool), r"`targets` must have shape \(60, 22, 3\)"),
        (np.zeros((60, 22, 3)), np.ones((60, 1), bool), r"`mask` must be bool of shape"),
        (np.zeros((60, 22, 3)), np.ones((60, 22)), r"`mask` must be bool of shape .* got float64"),
        (
            np.full((60, 22, 3), np.nan),
            np.ones((60, 22), bool),
            "`targets` must be finite wherever `mask` is true",
        ),
    ],
)
def test_targets_that_do_not_fit_are_refused(walking, targets, mask, message):
    with pytest.raises(ValueError, match=message):
        scene_of(walking, targets=targets, mask=mask)


def test_front_camera_sees_the_figures_left_on_the_right_and_up_above():
    seen = Camera(azimuth=0.0, elevation=0.0).project(np.array([[1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(seen, [[1.0, 2.0]], atol=1e-12)


def test_default_camera_sees_forward_run_right_and_nearer():
    camera, forward = Camera(), np.array([0.0, 0.0, 1.0])
    assert camera.project(forward)[0] > 0.5
    assert camera.depth(forward) > 0.5


def test_few_keyframes_are_among_the_shown_frames(controlled_walking):
    controlled_walking.extra["mask"][:, 0] = False
    shown = shown_frames(scene_of(controlled_walking), 10)
    assert {10, 30, 50} <= set(shown)
    assert shown[0] == 0
    assert shown[-1] == 59
    assert len(shown) == 10


def test_shorter_motion_shows_each_frame_once(walking):
    assert shown_frames(scene_of(Motion(joints=walking.joints[:3])), 10) == [0, 1, 2]


def test_left_and_right_limbs_have_two_colors_and_the_trunk_a_third(walking):
    colors = joint_colors(walking.skeleton)
    names = walking.skeleton.joint_names
    by_side = {
        side: {c for c, n in zip(colors, names, strict=True) if n.startswith(side)}
        for side in ("left", "right")
    }
    assert len(by_side["left"]) == len(by_side["right"]) == 1
    assert len({*by_side["left"], *by_side["right"], colors[names.index("spine2")]}) == 3


def test_paler_colors_end_at_the_color_and_at_paper():
    assert paler("#102030", 1.0) == "#102030"
    assert paler("#102030", 0.0) == "#ffffff"
