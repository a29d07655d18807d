"""The Motion value object and the lookup of file formats."""

from __future__ import annotations

import math

import pytest
import torch

from controlmm.motion.features import joints_to_features
from controlmm.motion.formats import known_suffixes
from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import KIT
from controlmm.ops import recover_joints


def test_features_are_decoded_and_kept(walking_joints):
    features = joints_to_features(walking_joints)
    motion = Motion.from_features(features, text="walk")
    assert torch.equal(motion.joints, recover_joints(features[None])[0])
    assert motion.features is features
    assert (motion.num_frames, motion.fps, motion.seconds, motion.text) == (59, 20.0, 2.95, "walk")


def test_kit_features_are_recognised_by_their_width():
    motion = Motion.from_features(torch.zeros(25, 251))
    assert motion.skeleton is KIT
    assert motion.seconds == 2.0


@pytest.mark.parametrize("shape", [(0, 22, 3), (5, 21, 3), (5, 22, 2), (22, 3)])
def test_joints_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match=r"`joints` must have shape \(T, 22, 3\)"):
        Motion(torch.zeros(shape))


def test_the_first_frame_that_is_not_finite_is_named():
    joints = torch.zeros(9, 22, 3)
    joints[6:, 3] = math.inf
    with pytest.raises(ValueError, match="`joints` must be finite; frame 6"):
        Motion(joints)


def test_features_must_belong_to_the_joints():
    with pytest.raises(ValueError, match=r"`features` must have shape \(9, 263\), got \(8, 263\)"):
        Motion(torch.zeros(9, 22, 3), torch.zeros(8, 263))


def test_features_of_another_width_are_refused():
    with pytest.raises(ValueError, match="263 wide"):
        Motion.from_features(torch.zeros(9, 260))


def test_unknown_suffixes_are_refused_with_the_known_ones(walking_joints, tmp_path):
    motion = Motion(walking_joints)
    with pytest.raises(ValueError, match=r"Unknown motion format '.fbx'. Use one of: .*bvh"):
        motion.save(tmp_path / "walk.fbx")
    with pytest.raises(ValueError, match="Unknown motion format"):
        Motion.load(tmp_path / "walk")
    assert {"npz", "npy", "bvh", "png", "gif", "mp4"} <= set(known_suffixes())


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"No motion file at .*none\.npz"):
        Motion.load(tmp_path / "none.npz")


def test_saving_makes_missing_folders(walking_joints, tmp_path):
    path = Motion(walking_joints).save(tmp_path / "a" / "b" / "walk.npz")
    assert path.is_file()
    assert torch.equal(Motion.load(path).joints, walking_joints)
