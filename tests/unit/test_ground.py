"""Standing a motion on the floor."""

import pytest
import torch

from controlmm import JointControl, PathControl
from controlmm.motion.ground import grounded
from controlmm.ops import recover_joints

ROUNDING = 1e-6  # metres; a subtraction of heights near 1 m in float32


def test_the_lowest_joint_of_each_clip_touches_the_floor_and_only_heights_change():
    features = torch.randn(3, 20, 263, generator=torch.Generator().manual_seed(0)) * 0.1
    before, after = recover_joints(features), recover_joints(grounded(features))
    torch.testing.assert_close(after[..., 1].flatten(1).amin(1), torch.zeros(3), atol=ROUNDING, rtol=0)
    torch.testing.assert_close(after[..., [0, 2]], before[..., [0, 2]], atol=0, rtol=0)
    shift = (after - before)[..., 1]
    torch.testing.assert_close(shift, shift[:, :1, :1].expand_as(shift), atol=ROUNDING, rtol=0)
    assert torch.equal(grounded(features)[..., 67:], features[..., 67:])


def test_a_motion_without_height_targets_stands_on_the_floor(tiny_pipeline):
    path = PathControl("pelvis", xz=[[0, 0], [0, 1]])
    for controls in ((), (path,)):
        joints = tiny_pipeline("walk", frames=16, controls=controls, preset="fast", seed=3).best.joints
        assert joints[..., 1].min().item() == pytest.approx(0, abs=ROUNDING)


def test_a_height_target_is_not_moved(tiny_pipeline):
    control = JointControl("head", frames=[8], positions=[[0.0, 1.5, 0.0]])
    result = tiny_pipeline("walk", frames=16, controls=[control], preset="fast", seed=3)
    measured = (result.best.joints[8, 15] - torch.tensor([0.0, 1.5, 0.0])).norm()
    torch.testing.assert_close(result.control_error[0], measured, atol=ROUNDING, rtol=0)
