"""Canonical placement, retargeting and features of synthetic walks, against truths worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from controlmm.motion.features import FACING_SIGMA, bone_lengths, canonicalize, joints_to_features, retarget
from controlmm.motion.layout import feature_layout
from controlmm.motion.mirror import mirror_features, mirror_joints
from controlmm.motion.skeleton import HUMANML3D, KIT
from controlmm.ops import recover_joints

MICROMETRES = 5e-6  # float32 positions up to 8 m from the origin, and 150 float32 yaw increments
LAYOUT = feature_layout(HUMANML3D)


def decode(features):
    return recover_joints(features[None])[0]


def test_canonical_clip_stands_on_the_ground_at_the_origin_and_faces_forward(walk):
    joints = canonicalize(walk(30, heading=2.0) + torch.tensor([3.0, -0.4, 5.0]))
    assert joints.dtype == torch.float32
    assert joints[..., 1].min() == pytest.approx(0, abs=1e-7)
    assert joints[0, 0, [0, 2]].abs().max() < 1e-6
    across = joints[0, 1] - joints[0, 2] + joints[0, 16] - joints[0, 17]  # to the left, which is +X
    assert across[0] > 0
    assert across[2] == pytest.approx(0, abs=1e-6)


def test_canonicalize_ignores_where_a_clip_stands_and_faces(walk, yawed):
    joints = walk(20)
    moved = yawed(joints, -1.1) + torch.tensor([4.0, 2.0, -7.0])
    torch.testing.assert_close(canonicalize(moved), canonicalize(joints), rtol=0, atol=MICROMETRES)


def test_a_clip_that_faces_exactly_backward_is_turned_by_half_a_turn(walking_joints):
    backward = walking_joints * torch.tensor([-1.0, 1.0, -1.0])
    symmetric = backward.clone()  # hips and shoulders exactly along X at frame 0
    symmetric[0, [1, 2, 16, 17], 2] = symmetric[0, 0, 2]
    turned = canonicalize(symmetric)
    torch.testing.assert_close(turned, symmetric * torch.tensor([-1.0, 1.0, -1.0]), rtol=0, atol=1e-6)


def test_features_of_a_clip_that_turns_to_exactly_backward_are_finite(walking_joints):
    pose = walking_joints[0].clone()
    pose[[1, 2, 13, 14], 2] += 0.01  # hip and collar bones exactly along -X would have no defined rotation
    pose[[1, 16], 2] = pose[[2, 17], 2]
    half_turn = torch.tensor([-1.0, 1.0, -1.0])
    frames = int(10 * FACING_SIGMA)  # long enough for the smoothed facing to reach both ends exactly
    clip = torch.cat([pose.expand(frames, 22, 3), (pose * half_turn).expand(frames, 22, 3)])
    clip[frames - 40 : frames + 40] = torch.stack([rotate(pose, a) for a in torch.linspace(0, math.pi, 80)])
    features = joints_to_features(clip, public_quirks=False)
    assert features[:, 0].sum().abs() * 2 == pytest.approx(math.pi, abs=1e-4)


def rotate(points, yaw):
    x, y, z = points.unbind(-1)
    return torch.stack([x * yaw.cos() + z * yaw.sin(), y, z * yaw.cos() - x * yaw.sin()], dim=-1)


@pytest.mark.parametrize("turn", [0.0, 2.5, -2.5, 7.0])
def test_repaired_features_decode_to_the_clip_up_to_one_yaw(walk, yawed, turn):
    joints = canonicalize(walk(150, turn=turn))
    decoded = decode(joints_to_features(joints, public_quirks=False))
    expected = joints[:-1]
    sideways, wanted = decoded[0, 1] - decoded[0, 2], expected[0, 1] - expected[0, 2]
    yaw = torch.atan2(sideways[0], sideways[2]) - torch.atan2(wanted[0], wanted[2])
    torch.testing.assert_close(decoded, yawed(expected, yaw), rtol=0, atol=MICROMETRES)


@pytest.mark.parametrize("turn", [0.3, -0.3])
def test_public_features_decode_to_the_clip_while_it_does_not_face_backward(walk, turn):
    joints = canonicalize(walk(100, turn=turn))
    torch.testing.assert_close(decode(joints_to_features(joints)), joints[:-1], rtol=0, atol=MICROMETRES)


def test_repaired_features_have_no_first_frame_jump(walk):
    joints = canonicalize(walk(60, turn=1.5))
    public = joints_to_features(joints)[:, 0].abs()
    repaired = joints_to_features(joints, public_quirks=False)[:, 0].abs()
    per_frame = 0.5 * 1.5 / 59
    assert repaired.max() < 1.5 * per_frame
    assert (
        public[0] > 3 * per_frame
    )  # the walk is smoothed over 80 frames, so its first heading is not its own


def test_left_turns_have_negative_half_angles(walk):
    """With phi the angle from +Z towards +X, the channel holds -(phi_{t+1} - phi_t) / 2."""
    per_frame = 0.01
    joints = canonicalize(walk(300, turn=per_frame * 299))
    middle = joints_to_features(joints, public_quirks=False)[120:180, 0]  # a steady turn survives smoothing
    torch.testing.assert_close(middle.mean(), torch.tensor(-per_frame / 2), rtol=0.02, atol=0)


@pytest.mark.parametrize("public_quirks", [True, False])
@pytest.mark.parametrize("turn", [0.4, -4.0])
def test_features_of_the_mirrored_clip_are_the_mirrored_features(walk, turn, public_quirks):
    joints = canonicalize(walk(90, turn=turn))
    actual = joints_to_features(mirror_joints(joints), public_quirks=public_quirks)
    expected = mirror_features(joints_to_features(joints, public_quirks=public_quirks))
    torch.testing.assert_close(actual, expected, rtol=0, atol=2e-6)  # humanml3d.md, section 6


def test_a_resting_pose_has_no_velocity_and_four_contacts(walking_joints):
    features = joints_to_features(walking_joints[:1].expand(10, 22, 3))
    moving = [LAYOUT.root_velocity, LAYOUT.joint_velocities]
    assert all(features[1:, group].abs().max() == 0 for group in moving)
    assert (features[:, LAYOUT.foot_contacts] == 1).all()
    torch.testing.assert_close(features[:, 3], walking_joints[:1, 0, 1].expand(9), rtol=0, atol=0)


@pytest.mark.parametrize(("step", "is_resting"), [(0.0440, 1.0), (0.0450, 0.0)])
def test_contact_threshold_is_two_thousandths_of_a_square_metre_per_frame(walking_joints, step, is_resting):
    sliding = walking_joints[:1] + torch.arange(5.0)[:, None, None] * torch.tensor([0.0, 0.0, step])
    assert (joints_to_features(sliding)[:, LAYOUT.foot_contacts] == is_resting).all()


def test_last_frame_can_be_rebuilt_from_the_joint_velocities(walk):
    joints = canonicalize(walk(80, turn=0.3))
    features = joints_to_features(joints)
    yaw = 2 * features[:-1, 0].double().sum()  # Rinv of the decoder turns by -theta about Y
    step = rotate(features[-1, LAYOUT.joint_velocities].double().unflatten(0, (22, 3)), -yaw)
    torch.testing.assert_close(decode(features)[-1] + step.float(), joints[-1], rtol=0, atol=MICROMETRES)


def test_retargeting_gives_the_reference_bone_lengths_and_scales_the_path_by_leg_length(walk):
    small = 0.8 * walk(20)
    actual = retarget(small, HUMANML3D.rest_offsets())
    lengths = bone_lengths(actual, HUMANML3D)
    torch.testing.assert_close(
        lengths, torch.tensor(HUMANML3D.bone_lengths).expand(20, 22), rtol=0, atol=1e-6
    )
    torch.testing.assert_close(actual[:, 0].double(), walk(20)[:, 0], rtol=0, atol=1e-6)


def test_retargeting_to_its_own_body_changes_nothing(walk):
    joints = walk(20)
    torch.testing.assert_close(
        retarget(joints, HUMANML3D.rest_offsets()).double(), joints, rtol=0, atol=MICROMETRES
    )


@pytest.mark.parametrize("shape", [(22, 3), (5, 22, 2), (1, 22, 3), (5, 24, 3)])
def test_features_refuse_other_shapes(shape):
    with pytest.raises(ValueError, match=r"22.*21"):
        joints_to_features(torch.zeros(shape))


def test_not_finite_joints_are_refused(walking_joints):
    walking_joints[3, 4, 1] = math.nan
    with pytest.raises(ValueError, match="`joints` must be finite"):
        joints_to_features(walking_joints)


def test_undefined_facing_is_blamed_on_its_own_frame(walking_joints):
    walking_joints[33, [1, 2, 16, 17]] = walking_joints[33, 0].clone()
    with pytest.raises(ValueError, match="frame 33 has no defined rotations"):
        joints_to_features(walking_joints)


@pytest.mark.parametrize("function", [joints_to_features, lambda x: retarget(x, HUMANML3D.rest_offsets())])
def test_bone_opposite_to_its_rest_direction_is_refused(walking_joints, function):
    walking_joints[7, 4] = walking_joints[7, 1] + torch.tensor(
        [0.0, 0.4, 0.0]
    )  # a knee straight above the hip
    with pytest.raises(ValueError, match="frame 7 has no defined rotations"):
        function(walking_joints)


def test_frame_0_that_faces_nowhere_is_refused(walking_joints):
    walking_joints[0, [1, 2, 16, 17]] = walking_joints[0, 0].clone()
    with pytest.raises(ValueError, match="Frame 0 faces nowhere"):
        canonicalize(walking_joints)


def test_legs_without_length_are_refused(walking_joints):
    walking_joints[0, 8] = walking_joints[0, 5] = walking_joints[0, 2]
    with pytest.raises(ValueError, match="legs of frame 0 have no length"):
        retarget(walking_joints, HUMANML3D.rest_offsets())


def test_kit_has_no_published_rest_offsets():
    with pytest.raises(ValueError, match="bone lengths of skeleton 'kit' are not published"):
        KIT.rest_offsets()
