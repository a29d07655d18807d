"""Joints -> features against arrays of the public processing scripts and released clips."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from controlmm.motion.features import canonicalize, joints_to_features, retarget
from controlmm.motion.layout import feature_layout
from controlmm.motion.skeleton import HUMANML3D, SKELETONS, skeleton_of_width
from controlmm.ops import recover_joints

# Errors that an independent implementation with float32 quaternions reached against the public scripts
# (humanml3d.md, 3.4). Rotations of bones nearly opposite to their rest direction are ill conditioned.
POSITIONS, ROTATIONS = 1e-6, 1e-5
NEARLY_OPPOSITE = 8e-5
AFTER_RETARGETING = 4.0  # times more: forward kinematics adds float32 rounding of five bones
KIT_MILLIMETRES = (
    1e-3  # rounding of float32 at 1 to 2 m; the bones point nearly opposite to their rest direction
)
KIT_ROTATIONS = 5e-4
RELEASED_FLOAT32 = 2e-6  # the released features and joints were both rounded to float32
WRAPPED_FRAME = 142  # of clip 000612: its yaw velocity has the wrong sign there

CASES = ["t2m_a", "t2m_wrap", "kit_a", "kit_wrap"]


@pytest.fixture(scope="module")
def golden(shared: Path) -> Path:
    return shared / "reference" / "golden"


@pytest.fixture(scope="module")
def synthetic(golden: Path) -> dict[str, torch.Tensor]:
    return {
        name: torch.from_numpy(array) for name, array in np.load(golden / "process_synthetic.npz").items()
    }


def largest_errors(actual: torch.Tensor, expected: torch.Tensor) -> tuple[float, float]:
    """Largest error of all groups but the rotations, and of the rotations."""
    rotations = feature_layout(skeleton_of_width(expected.shape[-1])).local_rotations
    error = (actual - expected).abs()
    others = error.clone()
    others[:, rotations] = 0
    return others.max().item(), error[:, rotations].max().item()


def limits(case: str) -> tuple[float, float]:
    if case.startswith("kit"):
        return KIT_MILLIMETRES, KIT_ROTATIONS
    return POSITIONS * AFTER_RETARGETING, NEARLY_OPPOSITE


@pytest.mark.parametrize("case", CASES)
def test_raw_joints_become_the_public_canonical_joints(synthetic, case):
    raw, offsets = synthetic[f"{case}_raw_joints"], synthetic[f"{case}_tgt_offsets"]
    actual = canonicalize(retarget(raw, offsets))
    torch.testing.assert_close(actual, synthetic[f"{case}_canonical_joints"], rtol=0, atol=limits(case)[0])


@pytest.mark.parametrize("case", CASES)
def test_raw_joints_become_the_public_features(synthetic, case):
    raw, offsets = synthetic[f"{case}_raw_joints"], synthetic[f"{case}_tgt_offsets"]
    actual = joints_to_features(canonicalize(retarget(raw, offsets)))
    others, rotations = largest_errors(actual, synthetic[f"{case}_features"])
    assert others <= limits(case)[0]
    assert rotations <= limits(case)[1]


@pytest.mark.parametrize("case", CASES)
def test_canonical_joints_become_the_public_features(synthetic, case):
    actual = joints_to_features(synthetic[f"{case}_canonical_joints"])
    others, rotations = largest_errors(actual, synthetic[f"{case}_features"])
    is_kit = case.startswith("kit")
    assert others <= (KIT_MILLIMETRES if is_kit else POSITIONS)
    assert rotations <= (NEARLY_OPPOSITE if is_kit else ROTATIONS)


@pytest.mark.parametrize("case", CASES)
def test_features_decode_to_the_public_joints(synthetic, case):
    features = joints_to_features(synthetic[f"{case}_canonical_joints"])
    expected = synthetic[f"{case}_recovered_joints"]
    actual = recover_joints(features[None], joints=expected.shape[1])[0]
    # One wrong bit of a yaw velocity turns all later frames: decoded joints are further apart than features.
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-2 if case.startswith("kit") else 1e-5)


@pytest.mark.parametrize("case", ["t2m_wrap", "kit_wrap"])
def test_wrap_cases_show_the_public_defect_and_the_repaired_mode_does_not(synthetic, case):
    canonical = synthetic[f"{case}_canonical_joints"]
    public = joints_to_features(canonical)[:, 0]
    repaired = joints_to_features(canonical, public_quirks=False)[:, 0]
    flipped = (public[1:] * repaired[1:] < 0) & (public[1:].abs() > 1e-3)
    assert flipped.sum() == 1  # one crossing of 180 degrees, one wrong sign
    torch.testing.assert_close(public[1:][~flipped], repaired[1:][~flipped], rtol=0, atol=POSITIONS * 10)
    torch.testing.assert_close(public[1:][flipped], -repaired[1:][flipped], rtol=0, atol=POSITIONS * 10)


def with_last_frame(features: torch.Tensor) -> torch.Tensor:
    """Decoded joints and one frame more, built from the joint velocities: X_T = X_{T-1} + R^-1 vel_{T-1}."""
    joints = recover_joints(features[None].double())[0]
    yaw = 2 * features[:-1, 0].double().sum()
    velocity = features[-1, feature_layout(HUMANML3D).joint_velocities].double().unflatten(0, (22, 3))
    x, y, z = velocity.unbind(-1)
    step = torch.stack([x * yaw.cos() - z * yaw.sin(), y, x * yaw.sin() + z * yaw.cos()], dim=-1)
    return torch.cat([joints, (joints[-1] + step)[None]])


def test_released_clip_012314_is_reproduced_from_its_own_joints(golden):
    features = torch.from_numpy(np.load(golden / "humanml3d" / "new_joint_vecs_012314.npy"))
    joints = torch.from_numpy(np.load(golden / "humanml3d" / "new_joints_012314.npy"))
    rebuilt = with_last_frame(features)
    torch.testing.assert_close(rebuilt[:-1].float(), joints, rtol=0, atol=RELEASED_FLOAT32)
    others, rotations = largest_errors(joints_to_features(rebuilt), features)
    assert others <= RELEASED_FLOAT32
    assert rotations <= ROTATIONS


def test_released_clip_000612_is_reproduced_once_its_wrong_sign_is_flipped(golden):
    stored = torch.from_numpy(np.load(golden / "momask" / "000612.npy")).float()
    right = stored.clone()
    right[WRAPPED_FRAME, 0] *= -1
    joints = with_last_frame(right)
    others, rotations = largest_errors(joints_to_features(joints), stored)  # makes the same wrong sign again
    assert others <= RELEASED_FLOAT32
    assert rotations <= NEARLY_OPPOSITE
    velocities = joints_to_features(joints, public_quirks=False)[:, 0]
    assert velocities[WRAPPED_FRAME] == pytest.approx(0.045446, abs=1e-6)


def test_bone_lengths_are_those_of_the_released_skeleton(golden):
    offsets = torch.from_numpy(np.load(golden / "t2m_reference_offsets.npy"))
    rounding = 5.1e-6  # the table is printed to five digits
    torch.testing.assert_close(HUMANML3D.rest_offsets(), offsets, rtol=0, atol=rounding)


def test_skeleton_constants_agree_with_the_synthetic_targets(synthetic):
    for case, name in (("t2m_a", "humanml3d"), ("kit_a", "kit")):
        offsets = synthetic[f"{case}_tgt_offsets"]
        directions = torch.tensor(SKELETONS[name].directions, dtype=offsets.dtype)
        lengths = offsets.abs().amax(-1, keepdim=True)
        torch.testing.assert_close(directions * lengths, offsets, rtol=0, atol=0)
