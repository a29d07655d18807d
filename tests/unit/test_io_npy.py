from __future__ import annotations

import numpy as np
import pytest
import torch

from controlmm.io.npy import NpyFormat
from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import HUMANML3D, KIT


@pytest.fixture
def path(tmp_path):
    return tmp_path / "walk.npy"


def motion_of_features(width: int) -> Motion:
    return Motion.from_features(0.1 * torch.randn(12, width, generator=torch.Generator().manual_seed(0)))


@pytest.mark.parametrize(("width", "skeleton"), [(263, HUMANML3D), (251, KIT)])
def test_features_come_back_with_their_joints(width, skeleton, path):
    motion = motion_of_features(width)
    NpyFormat.save(motion, path)
    assert np.load(path).shape == (12, width)
    loaded = NpyFormat.load(path)
    assert loaded.skeleton is skeleton
    assert torch.equal(loaded.features, motion.features)
    assert torch.equal(loaded.joints, motion.joints)


@pytest.mark.parametrize(("width", "joints"), [(263, 22), (251, 21)])
def test_joints_are_written_when_asked(width, joints, path):
    motion = motion_of_features(width)
    NpyFormat.save(motion, path, what="joints")
    assert np.load(path).shape == (12, joints, 3)
    loaded = NpyFormat.load(path)
    assert loaded.features is None
    assert torch.equal(loaded.joints, motion.joints)


def test_motion_without_features_writes_joints(walking, path):
    NpyFormat.save(walking, path)
    assert np.load(path).shape == (60, 22, 3)
    with pytest.raises(ValueError, match="`what` is 'features', but the motion has only joints"):
        NpyFormat.save(walking, path, what="features")


def test_unknown_choice_is_refused(walking, path):
    with pytest.raises(ValueError, match="`what` must be 'features' or 'joints', got 'bones'"):
        NpyFormat.save(walking, path, what="bones")


HUGE_HEADER = (
    b"\x93NUMPY\x01\x00\x4c\x00{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000, 22, 3), } \n"
)


def array(values, **options):
    return lambda path: np.save(path, values, **options)


def raw(content):
    return lambda path: path.write_bytes(content)


def archive(path):
    with path.open("wb") as file:
        np.savez(file, a=np.zeros(3))


DAMAGED = "damaged or not a NumPy array"
BAD = {
    "other shape": (array(np.zeros((4, 24, 3))), r"expected features .* got \(4, 24, 3\)"),
    "no frames": (array(np.zeros((0, 22, 3))), r"T >= 1, got \(0, 22, 3\)"),
    "scalar": (array(np.float32(1)), "expected features"),
    "words": (array(np.array(["a"])), "expected numbers, got <U1"),
    "NaN": (array(np.full((4, 263), np.nan)), "expected finite numbers"),
    "pickled": (array(np.array([{}], dtype=object), allow_pickle=True), DAMAGED),
    "archive": (archive, DAMAGED),
    "text": (raw(b"hello"), DAMAGED),
    "empty": (raw(b""), DAMAGED),
    "huge header": (raw(HUGE_HEADER), DAMAGED),
    "open bracket in the header": (raw(HUGE_HEADER.replace(b")", b" ")), DAMAGED),
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_or_foreign_files_raise_one_line_that_names_the_file(name, path):
    write, message = BAD[name]
    write(path)
    with pytest.raises(ValueError, match=message) as error:
        NpyFormat.load(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_truncated_file_is_refused(walking, path):
    NpyFormat.save(walking, path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(ValueError, match="damaged or not a NumPy array"):
        NpyFormat.load(path)
