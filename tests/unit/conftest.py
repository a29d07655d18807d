"""Motions that several unit tests draw, write and fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import HUMANML3D

_DATA = Path(__file__).resolve().parents[3] / "shared" / "data"

# Offsets of a made-up body in its T-pose, metres: hips and collars oblique, as real ones are.
_OFFSETS = {
    "left_hip": (0.06, -0.08, -0.01), "right_hip": (-0.07, -0.08, -0.01),
    "left_knee": (0, -0.4, 0), "right_knee": (0, -0.4, 0),
    "left_ankle": (0, -0.42, 0), "right_ankle": (0, -0.42, 0),
    "left_foot": (0, -0.06, 0.13), "right_foot": (0, -0.06, 0.13),
    "spine1": (0, 0.12, -0.02), "spine2": (0, 0.14, 0), "spine3": (0, 0.06, 0),
    "neck": (0, 0.22, -0.02), "head": (0, 0.08, 0.06),
    "left_collar": (0.07, 0.12, -0.02), "right_collar": (-0.08, 0.12, -0.02),
    "left_shoulder": (0.13, 0, 0), "right_shoulder": (-0.12, 0, 0),
    "left_elbow": (0.26, 0, 0), "right_elbow": (-0.26, 0, 0),
    "left_wrist": (0.25, 0, 0), "right_wrist": (-0.25, 0, 0),
}  # fmt: skip


def _turn(axis: int, angle: np.ndarray) -> np.ndarray:
    """Rotation matrices (T, 3, 3) by ``angle`` radians about coordinate axis ``axis``."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    result = np.zeros((len(angle), 3, 3))
    result[:, axis, axis] = 1
    result[:, u, u] = result[:, v, v] = np.cos(angle)
    result[:, v, u], result[:, u, v] = np.sin(angle), -np.sin(angle)
    return result


def _walking_rotations(frames: int) -> dict[str, np.ndarray]:
    """Local rotations of a walk along a curve: hinges for knees and elbows, arms that hang and swing."""
    phase = 2 * np.pi * np.arange(frames) / 22
    one = np.ones(frames)
    return {
        "pelvis": _turn(1, 0.3 * np.arange(frames) / 40) @ _turn(2, 0.05 * np.sin(phase)),
        "spine1": _turn(0, 0.1 * one),
        "spine3": _turn(1, 0.15 * np.sin(phase)),
        "left_hip": _turn(0, -0.5 * np.sin(phase) - 0.1),
        "right_hip": _turn(0, 0.5 * np.sin(phase) - 0.1),
        "left_knee": _turn(0, 0.35 + 0.35 * np.cos(phase)),
        "right_knee": _turn(0, 0.35 - 0.35 * np.cos(phase)),
        "left_shoulder": _turn(2, -1.25 * one) @ _turn(1, 0.4 * np.sin(phase)),
        "right_shoulder": _turn(2, 1.25 * one) @ _turn(1, 0.4 * np.sin(phase)),
        "left_elbow": _turn(1, -0.7 * one),
        "right_elbow": _turn(1, 0.7 * one),
    }


def walking_joints(frames: int) -> torch.Tensor:
    """(T, 22, 3) float64 joints in metres of a rigid body that walks, by its own forward kinematics."""
    local = _walking_rotations(frames)
    identity = np.tile(np.eye(3), (frames, 1, 1))
    phase = 2 * np.pi * np.arange(frames) / 22
    height = 0.93 + 0.02 * np.cos(2 * phase)
    root = np.stack([0.1 * np.sin(phase / 3), height, 0.055 * np.arange(frames)], axis=1)
    positions, rotations = [root], [local["pelvis"]]
    for name, parent in zip(HUMANML3D.joint_names[1:], HUMANML3D.parents[1:], strict=True):
        positions.append(positions[parent] + rotations[parent] @ np.array(_OFFSETS[name], dtype=np.float64))
        rotations.append(rotations[parent] @ local.get(name, identity))
    return torch.from_numpy(np.stack(positions, axis=1))


@pytest.fixture
def walking() -> Motion:
    """60 frames of a rigid body that walks."""
    return Motion(joints=walking_joints(60).float(), text="a person walks forward")


@pytest.fixture
def controlled_walking(walking: Motion) -> Motion:
    """The walk with a ground path for the pelvis (height free) and three wrist targets, 3 cm off."""
    targets = torch.full_like(walking.joints, torch.nan)
    mask = torch.zeros(walking.joints.shape, dtype=torch.bool)
    mask[:, 0, [0, 2]] = True
    mask[[10, 30, 50], 21] = True
    targets[mask] = walking.joints[mask]
    targets[[10, 30, 50], 21, 1] += 0.03
    walking.extra.update(targets=targets, mask=mask)
    return walking


@pytest.fixture(scope="session")
def real_clips() -> list[torch.Tensor]:
    """Joints (T, 22, 3) in metres of one clip of each data pack."""
    if not _DATA.is_dir():
        pytest.skip("needs the data packs in ../shared/data")
    clips = []
    for pack, index in (("cmu", 200), ("bandai_namco", 700), ("cmu_dance", 20), ("hdm05", 30)):
        arrays = np.load(_DATA / f"{pack}.npz")
        start, end = arrays["offsets"][index : index + 2]
        root = arrays["root"][start:end].astype(np.float64)[:, None]
        relative = arrays["rel"][start:end] * float(arrays["rel_unit"])
        clips.append(torch.from_numpy(np.concatenate([root, root + relative], axis=1)))
    return clips
