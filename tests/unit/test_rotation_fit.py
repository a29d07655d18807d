from __future__ import annotations

import time

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from controlmm.motion.rotation_fit import RotationFit, fit_rotations
from controlmm.motion.rotations import quat_multiply, quat_rotate, quat_to_matrix
from controlmm.motion.skeleton import HUMANML3D, KIT, SKELETONS, Skeleton
from controlmm.motion.t_pose import t_pose_directions

EXACT = 1e-8  # metres; double arithmetic along eight bones, and the prior of `best_rotation`
FLOAT32 = 2e-6  # metres; rounding of float32 positions a few metres from the origin
RIGID_PACKS = 5e-4  # metres; the packs' bones are rigid to 0.1 mm
# 1 cm of jitter per joint: along the bone it cannot be followed, across it can.
JITTER_MEAN, JITTER_MAX = 0.009, 0.05


def forward_kinematics(fit: RotationFit) -> torch.Tensor:
    """Positions from the fit's own rotations and offsets, by matrices instead of the module under test."""
    matrices = quat_to_matrix(fit.local_rotations)
    turned, placed = [matrices[:, 0]], [fit.root_positions]
    for joint, parent in list(enumerate(fit.skeleton.parents))[1:]:
        placed.append(placed[parent] + turned[parent] @ fit.offsets[joint])
        turned.append(turned[parent] @ matrices[:, joint])
    return torch.stack(placed, dim=1)


def random_rigid_motion(skeleton: Skeleton, *, seed: int, frames: int = 12) -> torch.Tensor:
    """A T-pose body that tumbles with random rotations at every joint, metres."""
    generator = torch.Generator().manual_seed(seed)
    lengths = 0.1 + 0.3 * torch.rand(skeleton.num_joints, generator=generator, dtype=torch.float64)
    offsets = t_pose_directions(skeleton) * lengths[:, None]
    local = torch.randn(frames, skeleton.num_joints, 4, generator=generator, dtype=torch.float64)
    local = local / local.norm(dim=-1, keepdim=True)
    placed = [torch.randn(frames, 3, generator=generator, dtype=torch.float64)]
    turned = [local[:, 0]]
    for joint, parent in list(enumerate(skeleton.parents))[1:]:
        placed.append(placed[parent] + quat_rotate(turned[parent], offsets[joint]))
        turned.append(quat_multiply(turned[parent], local[:, joint]))
    return torch.stack(placed, dim=1)


def step_degrees(fit: RotationFit) -> torch.Tensor:
    q = fit.local_rotations
    return torch.rad2deg(2 * torch.acos((q[1:] * q[:-1]).sum(-1).clamp(-1, 1)))


def assert_sound(fit: RotationFit) -> None:
    assert torch.isfinite(fit.joints).all()
    torch.testing.assert_close(
        fit.local_rotations.norm(dim=-1), torch.ones(fit.local_rotations.shape[:2]).double()
    )
    torch.testing.assert_close(forward_kinematics(fit), fit.joints, rtol=0, atol=EXACT)


def test_rigid_walk_is_fitted_exactly(walking):
    fit = fit_rotations(walking.joints)
    assert fit.max_error < FLOAT32
    assert_sound(fit)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), name=st.sampled_from(sorted(SKELETONS)))
def test_any_rigid_motion_is_fitted_exactly(seed, name):
    joints = random_rigid_motion(SKELETONS[name], seed=seed)
    fit = fit_rotations(joints, SKELETONS[name])
    assert fit.max_error < EXACT
    assert_sound(fit)


def test_rest_pose_is_a_t_pose(walking):
    offsets = fit_rotations(walking.joints).offsets
    directions = {
        name: offset / offset.norm()
        for name, offset in zip(HUMANML3D.joint_names, offsets, strict=True)
        if offset.norm()
    }
    for name in ("left_shoulder", "left_elbow", "left_wrist"):
        assert directions[name].tolist() == [1, 0, 0]
    for name in ("right_shoulder", "right_elbow", "right_wrist"):
        assert directions[name].tolist() == [-1, 0, 0]
    for name in ("left_knee", "right_knee", "left_ankle", "right_ankle"):
        assert directions[name].tolist() == [0, -1, 0]
    for name in ("spine1", "spine2", "spine3", "neck"):
        assert directions[name][1] > 0.95
    for name in ("left_foot", "right_foot"):
        assert directions[name][2] > 0.85
    assert directions["left_hip"][0] > 0 > directions["right_hip"][0]


def test_bone_lengths_are_the_means_over_the_clip(walking):
    stretched = walking.joints.double() * torch.linspace(0.9, 1.1, 60, dtype=torch.float64)[:, None, None]
    fit = fit_rotations(stretched)
    torch.testing.assert_close(fit.offsets.norm(dim=-1), fit_rotations(walking.joints).offsets.norm(dim=-1))


def test_reference_lengths_are_the_skeletons(walking):
    fit = fit_rotations(walking.joints, bone_lengths="reference")
    expected = torch.tensor(HUMANML3D.bone_lengths, dtype=torch.float64)
    torch.testing.assert_close(fit.offsets.norm(dim=-1), expected)
    assert 0 < fit.max_error < 0.2


def test_turning_the_scene_turns_the_fit(walking):
    turn = torch.tensor([0.6, 0.0, 0.8, 0.0], dtype=torch.float64)
    joints = walking.joints.double()
    jittered = joints + 0.01 * torch.randn(
        joints.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    expected = quat_rotate(turn, fit_rotations(jittered).joints)
    torch.testing.assert_close(fit_rotations(quat_rotate(turn, jittered)).joints, expected, rtol=0, atol=1e-6)


def test_mirrored_motion_gives_mirrored_joints(walking):
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    joints = walking.joints.double()
    mirrored = (joints * flip)[:, list(HUMANML3D.mirror)]
    back = (fit_rotations(mirrored).joints * flip)[:, list(HUMANML3D.mirror)]
    torch.testing.assert_close(back, fit_rotations(joints).joints, rtol=0, atol=1e-6)


def test_knees_and_elbows_bend_as_hinges(walking):
    rotations = fit_rotations(walking.joints).local_rotations
    for name, axis in (("left_knee", 0), ("right_knee", 0), ("left_elbow", 1), ("right_elbow", 1)):
        q = rotations[:, HUMANML3D.joint_index(name)]
        is_bent = 2 * torch.acos(q[:, 0].abs().clamp(max=1)) > 0.6  # radians
        assert is_bent.any()
        share = q[is_bent, 1 + axis].abs() / q[is_bent, 1:].norm(dim=-1)
        assert share.min() > 0.95, name


def test_spine_shares_the_twist_of_the_chest():
    from_front = torch.linspace(0, 1.2, 30, dtype=torch.float64)
    joints = random_rigid_motion(HUMANML3D, seed=0, frames=1).expand(30, -1, -1).clone()
    lengths = (joints[0, 1:] - joints[0, list(HUMANML3D.parents[1:])]).norm(dim=-1)
    offsets = t_pose_directions(HUMANML3D)
    offsets[1:] *= lengths[:, None]
    zero = torch.zeros_like(from_front)
    chest = torch.stack([(from_front / 2).cos(), zero, (from_front / 2).sin(), zero], dim=-1)
    joints[:, 0] = 0
    for joint, parent in list(enumerate(HUMANML3D.parents))[1:]:
        above_chest = joint in (12, 15) or joint >= 13
        offset = offsets[joint].expand(30, 3)
        joints[:, joint] = joints[:, parent] + (quat_rotate(chest, offset) if above_chest else offset)
    twists = 2 * torch.atan2(fit_rotations(joints).local_rotations[-1, [3, 6, 9], 2], torch.tensor(1.0))
    assert twists.min() > 0.2
    assert twists.max() < 0.6


def test_jitter_is_followed_within_its_size(walking):
    noise = torch.randn(walking.joints.shape, generator=torch.Generator().manual_seed(0)) * 0.01 / 3**0.5
    fit = fit_rotations(walking.joints + noise)
    assert fit.mean_error < JITTER_MEAN
    assert fit.max_error < JITTER_MAX
    assert step_degrees(fit).max() < 90


def test_neighbouring_frames_are_in_one_hemisphere_and_do_not_jump(walking):
    fit = fit_rotations(walking.joints)
    assert (fit.local_rotations[1:] * fit.local_rotations[:-1]).sum(-1).min() > 0
    assert step_degrees(fit).max() < 25  # the hips swing by 8 degrees a frame at most, the knees by 6


def test_limb_that_passes_its_opposite_direction_does_not_spin(walking):
    joints = walking.joints[:1].double().expand(41, -1, -1).clone()
    angle = torch.linspace(2.6, 3.7, 41, dtype=torch.float64)  # through the half turn from the rest direction
    arm = torch.stack([angle.cos(), angle.sin(), torch.full_like(angle, 0.02)], dim=-1)
    for joint, length in ((18, 0.26), (20, 0.51)):
        joints[:, joint] = joints[:, 16] + length * arm
    fit = fit_rotations(joints)
    assert_sound(fit)
    assert step_degrees(fit)[:, 16].max() < 20


DEGENERATE = {
    "one point": torch.zeros(5, 22, 3),
    "one frame": torch.randn(1, 22, 3, generator=torch.Generator().manual_seed(1)),
    "one line": torch.arange(22.0)[None, :, None].expand(4, -1, 3) * torch.tensor([0.0, 0.05, 0.0]),
    "opposite every other frame": torch.randn(1, 22, 3, generator=torch.Generator().manual_seed(2))
    * torch.tensor([1.0, -1.0, 1.0, -1.0])[:, None, None],
    "far and tiny": 1e3 + 1e-6 * torch.randn(3, 22, 3, generator=torch.Generator().manual_seed(3)),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_poses_give_finite_rotations(name):
    assert_sound(fit_rotations(DEGENERATE[name]))


def test_straight_up_limbs_opposite_to_rest_are_fitted():
    joints = torch.zeros(2, 22, 3, dtype=torch.float64)
    directions = -t_pose_directions(HUMANML3D)  # every bone antiparallel to its rest direction
    for joint, parent in list(enumerate(HUMANML3D.parents))[1:]:
        joints[:, joint] = joints[:, parent] + 0.2 * directions[joint]
    assert_sound(fit_rotations(joints))


def test_real_clips_fit_to_less_than_half_a_millimetre_in_under_a_second(real_clips):
    for joints in real_clips:
        start = time.process_time()
        fit = fit_rotations(joints)
        assert time.process_time() - start < 1.0
        assert fit.max_error < RIGID_PACKS
        assert_sound(fit)


def test_kit_clip_is_fitted_in_its_own_unit():
    joints = 1000 * random_rigid_motion(KIT, seed=5)
    assert fit_rotations(joints, KIT).max_error < 1000 * EXACT


@pytest.mark.parametrize(
    ("joints", "skeleton", "options", "message"),
    [
        (torch.zeros(4, 21, 3), HUMANML3D, {}, r"`joints` must have shape \(T, 22, 3\)"),
        (torch.zeros(0, 22, 3), HUMANML3D, {}, r"with T >= 1"),
        (torch.full((4, 22, 3), torch.nan), HUMANML3D, {}, r"`joints` must be finite"),
        (torch.zeros(4, 22, 3), HUMANML3D, {"bone_lengths": "longest"}, r"`bone_lengths` must be 'clip' or"),
        (torch.zeros(4, 21, 3), KIT, {"bone_lengths": "reference"}, r"not published"),
    ],
)
def test_bad_input_is_refused(joints, skeleton, options, message):
    with pytest.raises(ValueError, match=message):
        fit_rotations(joints, skeleton, **options)
