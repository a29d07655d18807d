"""The closed end as a whole: features of moved joints, targets met with whole bones; targets out of reach."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from controlmm.controls import JointControl, densify
from controlmm.generation.exact import meet_exactly
from controlmm.generation.exact.refit import refit_features
from controlmm.motion.features import bone_lengths, canonicalize, joints_to_features
from controlmm.motion.layout import feature_layout
from controlmm.motion.rotations import quat_to_matrix, rot6d_to_matrix
from controlmm.motion.skeleton import HUMANML3D
from controlmm.ops import recover_joints
from controlmm.pipelines import PRESETS
from controlmm.pipelines.reach import chain_lengths, check_reach

TENTH_OF_A_MILLIMETRE = 1e-4
ROUNDING = 1e-6  # of float32 features: sums of velocities, and turns by no angle
LENGTHS = HUMANML3D.rest_offsets().norm(dim=-1)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.fixture
def features(walk) -> torch.Tensor:
    return joints_to_features(canonicalize(walk(41)))


def joints_of(features: torch.Tensor) -> torch.Tensor:
    return recover_joints(features[None].double(), joints=22)[0]


def test_features_are_fitted_to_moved_joints(features):
    moved = joints_of(features) + 0.05 * random(40, 22, 3, seed=2)
    moved[0, 0, [0, 2]] = 0
    fitted = refit_features(features, moved, HUMANML3D)
    torch.testing.assert_close(joints_of(fitted), moved, rtol=0, atol=1e-5)


@pytest.fixture
def made(features) -> torch.Tensor:
    """As a decoder leaves them: rotations are no unit vectors, velocities are not those of the positions."""
    layout, made = feature_layout(HUMANML3D), features.clone()
    made[:, layout.local_rotations] += 0.2 * random(40, 126, seed=4).float()
    made[:, layout.joint_velocities] += 0.05 * random(40, 66, seed=5).float()
    return made


def test_features_of_joints_that_did_not_move_stay(made):
    fitted = refit_features(made, joints_of(made), HUMANML3D)
    rotations = feature_layout(HUMANML3D).local_rotations
    torch.testing.assert_close(fitted[:, rotations], made[:, rotations], rtol=0, atol=ROUNDING)
    fitted[:, rotations] = made[:, rotations]
    torch.testing.assert_close(fitted, made, rtol=0, atol=ROUNDING)


def test_velocities_change_by_what_those_of_the_joints_change_by(made):
    """Of the joint that moved, seen from the heading; those of all others are the network's."""
    layout, joints, lift = feature_layout(HUMANML3D), joints_of(made), torch.linspace(0, 0.2, 40)
    joints[:, 20, 1] += lift
    fitted = refit_features(made, joints, HUMANML3D)
    change = (fitted - made)[:, layout.joint_velocities].unflatten(1, (22, 3))
    expected = torch.zeros(40, 22, 3)
    expected[:-1, 20, 1] = lift.diff()  # a heading turns about Y
    torch.testing.assert_close(change, expected, rtol=0, atol=ROUNDING)
    assert torch.equal(fitted[:, layout.root_velocity], made[:, layout.root_velocity])


def test_rotations_turn_with_the_bones(features):
    """Forward kinematics of the fitted rotations points every bone as the moved joints do."""
    moved = joints_of(features) + 0.05 * random(40, 22, 3, seed=2)
    moved[0, 0, [0, 2]] = 0
    fitted = refit_features(features, moved, HUMANML3D).double()
    layout = feature_layout(HUMANML3D)
    half_turn = torch.cat([torch.zeros(1), fitted[:-1, layout.root_yaw_velocity].flatten().cumsum(0)])
    zero = torch.zeros_like(half_turn)
    current = torch.stack([half_turn.cos(), zero, half_turn.sin(), zero], dim=-1).double()
    local = rot6d_to_matrix(fitted[:, layout.local_rotations].unflatten(1, (21, 6)))
    rest = HUMANML3D.rest_offsets().double()
    for chain in HUMANML3D.chains:
        turned = quat_to_matrix(current)
        for parent, child in pairwise(chain):
            turned = turned @ local[:, child - 1]
            bone = moved[:, child] - moved[:, parent]
            expected = bone / bone.norm(dim=-1, keepdim=True) * LENGTHS[child]
            torch.testing.assert_close(turned @ rest[child], expected, rtol=0, atol=1e-4)


def test_rotations_that_a_decoder_bent_are_turned_by_no_more_than_the_bones(made):
    """What the network made of rotations stays where joints stay."""
    layout, joints = feature_layout(HUMANML3D), joints_of(made)
    angles = made[:, layout.local_rotations].unflatten(1, (21, 6))
    joints[:, 20] += torch.tensor([0.0, 0.1, 0.0])
    fitted = refit_features(made, joints, HUMANML3D)[:, layout.local_rotations].unflatten(1, (21, 6))
    others = [joint - 1 for joint in range(1, 22) if joint != 20]
    torch.testing.assert_close(fitted[:, others], angles[:, others], rtol=0, atol=ROUNDING)
    assert (fitted[:, 19] - angles[:, 19]).abs().amax() > 0.1


@pytest.fixture
def reach(features):
    """A wrist and the pelvis to be 10 to 20 cm elsewhere."""
    targets, mask = joints_of(features), torch.zeros(40, 22, 3, dtype=torch.bool)
    targets[30, 20] += torch.tensor([0.1, 0.15, 0.1])
    targets[15, 0] += torch.tensor([0.1, -0.05, 0.1])
    mask[30, 20] = mask[15, 0] = True
    return targets, mask


def test_the_exact_mode_meets_targets_with_whole_bones(features, reach):
    targets, mask = reach
    fitted, report = meet_exactly(features, targets, mask, HUMANML3D)
    joints = joints_of(fitted)
    assert (joints - targets)[mask].abs().max() < TENTH_OF_A_MILLIMETRE
    assert (bone_lengths(joints, HUMANML3D) - LENGTHS)[:, 1:].abs().max() < 1e-3
    assert report.residual[0] > 0.1 > TENTH_OF_A_MILLIMETRE > report.residual[1]
    assert report.bone_error[1] < 1e-3
    assert report.slide[1] <= 1.05 * report.slide[0] + 0.01


def test_the_exact_mode_leaves_a_motion_that_is_there_alone(features):
    fitted, _ = meet_exactly(
        features, joints_of(features), torch.zeros(40, 22, 3, dtype=torch.bool), HUMANML3D
    )
    torch.testing.assert_close(joints_of(fitted), joints_of(features), rtol=0, atol=2e-4)


def test_chains_add_their_bones():
    lengths = chain_lengths(HUMANML3D)
    arm = LENGTHS[[3, 6, 9, 13, 16, 18, 20]].sum()
    torch.testing.assert_close(lengths[0, 20], arm)
    torch.testing.assert_close(lengths[10, 11], LENGTHS[[1, 4, 7, 10, 2, 5, 8, 11]].sum())
    assert torch.equal(lengths, lengths.T)


@pytest.fixture
def impossible():
    return [
        JointControl("pelvis", frames=[8], positions=[[0.0, 0.9, 0.0]]),
        JointControl("left_wrist", frames=[8], positions=[[3.0, 0.9, 0.0]]),
    ]


MESSAGE = (
    r"`controls` ask for the impossible: in frame 8, left_wrist is to be 3\.00 m away from pelvis, but the "
    r"bones between them reach 1\.12 m\. Move one of them, or leave one free\."
)


def test_targets_out_of_reach_are_reported_with_the_distance(impossible):
    dense = densify(impossible, 16, HUMANML3D)
    with pytest.raises(ValueError, match=MESSAGE):
        check_reach(dense, HUMANML3D, is_strict=True)
    with pytest.warns(UserWarning, match=MESSAGE):
        check_reach(dense, HUMANML3D, is_strict=False)


def test_targets_within_reach_are_not_complained_about(impossible):
    near = JointControl("left_wrist", frames=[8], positions=[[1.0, 0.9, 0.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_reach(densify([impossible[0], near], 16, HUMANML3D), HUMANML3D, is_strict=True)
        check_reach(densify(impossible[1:], 16, HUMANML3D), HUMANML3D, is_strict=True)


def test_the_exact_preset_refuses_the_impossible_before_any_network_runs(tiny_pipeline, impossible):
    tiny_pipeline.transformer = None
    with pytest.raises(ValueError, match="`controls` ask for the impossible"):
        tiny_pipeline("a person reaches", frames=16, controls=impossible, preset="exact")


def test_the_exact_preset_meets_targets_to_a_tenth_of_a_millimetre(tiny_pipeline):
    budget = replace(PRESETS["exact"].budget, latent_iterations=5)
    plan = replace(PRESETS["exact"], budget=budget, steps=2)
    control = JointControl("right_wrist", frames=[9], positions=[[0.3, 1.2, 0.2]])
    result = tiny_pipeline("a person reaches", frames=16, controls=[control], preset=plan, samples=2)
    assert result.control_error.max() < TENTH_OF_A_MILLIMETRE
    assert len(result.exact) == 2
    for motion, report in zip(result, result.exact, strict=True):
        assert (motion.joints[9, 21] - torch.tensor([0.3, 1.2, 0.2])).abs().max() < TENTH_OF_A_MILLIMETRE
        assert report.residual[1] < TENTH_OF_A_MILLIMETRE
