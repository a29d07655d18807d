from __future__ import annotations

import pytest
import torch

from controlmm.motion.formats import known_suffixes
from controlmm.motion.motion import Motion

POSITIONS = 1e-5  # metres; six decimal digits of a BVH


def test_every_format_is_registered():
    assert {"npz", "npy", "bvh", "glb", "png", "gif", "mp4"} <= set(known_suffixes())


@pytest.mark.parametrize("suffix", ["npz", "npy", "bvh", "BVH"])
def test_motion_comes_back_from_the_file_its_suffix_names(walking, tmp_path, suffix):
    path = walking.save(tmp_path / "new" / f"walk.{suffix}")
    torch.testing.assert_close(Motion.load(path).joints, walking.joints, rtol=0, atol=POSITIONS)
    assert [file.name for file in path.parent.iterdir()] == [f"walk.{suffix}"]


@pytest.mark.parametrize(("suffix", "options"), [("png", {"dpi": 40}), ("gif", {"size": (160, 160)})])
def test_pictures_are_written_by_suffix(walking, tmp_path, suffix, options):
    path = Motion(joints=walking.joints[:6]).save(tmp_path / f"walk.{suffix}", **options)
    assert path.stat().st_size > 1000


@pytest.mark.parametrize("suffix", ["npz", "npy", "bvh"])
def test_missing_file_is_named(tmp_path, suffix):
    with pytest.raises(FileNotFoundError, match=f"No motion file at .*gone.{suffix}"):
        Motion.load(tmp_path / f"gone.{suffix}")
