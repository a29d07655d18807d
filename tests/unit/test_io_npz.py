from __future__ import annotations

import zipfile

import numpy as np
import pytest
import torch

from controlmm.io.npz import NpzFormat
from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import KIT


@pytest.fixture
def path(tmp_path):
    return tmp_path / "walk.npz"


def test_everything_a_motion_holds_comes_back_bit_for_bit(controlled_walking, path):
    features = torch.randn(60, 263, generator=torch.Generator().manual_seed(0))
    motion = Motion(
        joints=controlled_walking.joints,
        features=features,
        text="läuft „vor“",
        extra=controlled_walking.extra,
    )
    NpzFormat.save(motion, path)
    loaded = NpzFormat.load(path)
    assert torch.equal(loaded.joints, motion.joints)
    assert torch.equal(loaded.features, features)
    assert loaded.text == "läuft „vor“"
    assert loaded.skeleton is motion.skeleton
    assert torch.equal(loaded.extra["mask"], motion.extra["mask"])
    torch.testing.assert_close(
        loaded.extra["targets"], motion.extra["targets"], rtol=0, atol=0, equal_nan=True
    )


def test_kit_motion_without_features_comes_back(path):
    motion = Motion(joints=torch.randn(5, 21, 3, generator=torch.Generator().manual_seed(0)), skeleton=KIT)
    NpzFormat.save(motion, path)
    loaded = NpzFormat.load(path)
    assert loaded.skeleton is KIT
    assert loaded.features is None
    assert loaded.extra == {}
    assert torch.equal(loaded.joints, motion.joints)


def test_archive_opens_without_pickle_and_names_its_arrays(controlled_walking, path):
    NpzFormat.save(controlled_walking, path)
    with np.load(path, allow_pickle=False) as arrays:
        assert set(arrays.files) == {"joints", "fps", "skeleton", "text", "targets", "mask"}
        assert arrays["fps"] == 20
        assert arrays["joints"].dtype == np.float32


def test_failed_save_keeps_the_older_file(controlled_walking, path):
    NpzFormat.save(controlled_walking, path)
    before = path.read_bytes()
    controlled_walking.extra["mask"] = torch.ones(3, dtype=torch.bool)
    with pytest.raises(
        ValueError, match=r"`mask` must have shape \(60, 22, 3\), as `joints` has, got \(3,\)"
    ):
        NpzFormat.save(controlled_walking, path)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def foreign(path):
    np.savez(path, poses=np.zeros((4, 156)), trans=np.zeros((4, 3)))


def pickled(path):
    np.savez(path, joints=np.array([{"evil": 1}], dtype=object), skeleton="humanml3d", fps=20.0)


def huge_header(path):
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000, 22, 3), }"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("joints.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)


def saved(**changes):
    def write(path):
        arrays = {"joints": np.zeros((4, 22, 3), np.float32), "skeleton": "humanml3d", "fps": 20.0} | changes
        np.savez(path, **arrays)

    return write


BAD = {
    "foreign": (foreign, r"not a motion archive, it lacks joints, skeleton, fps \(found: poses, trans\)"),
    "pickled": (pickled, "damaged or not a NumPy archive"),
    "huge header": (huge_header, "damaged or not a NumPy archive"),
    "text": (lambda path: path.write_text("hello"), "damaged or not a NumPy archive"),
    "empty": (lambda path: path.write_bytes(b""), "damaged or not a NumPy archive"),
    "other rate": (saved(fps=30.0), "`fps` must be 20 for the humanml3d skeleton, got 30"),
    "other skeleton": (saved(skeleton="smplx"), "unknown skeleton 'smplx', expected one of: humanml3d, kit"),
    "other joints": (saved(joints=np.zeros((4, 24, 3))), r"`joints` must have shape \(T, 22, 3\)"),
    "NaN": (saved(joints=np.full((4, 22, 3), np.nan)), "`joints` must be finite"),
    "words": (saved(joints=np.full((4, 22, 3), "a")), "`joints` must hold numbers"),
    "NaN features": (saved(features=np.full((4, 263), np.nan)), "`features` must be finite"),
    "short mask": (saved(mask=np.ones((2, 22, 3), bool)), r"`mask` must have shape \(4, 22, 3\)"),
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_or_foreign_files_raise_one_line_that_names_the_file(name, path):
    write, message = BAD[name]
    write(path)
    with pytest.raises(ValueError, match=message) as error:
        NpzFormat.load(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_archive_that_unpacks_to_too_much_is_not_unpacked(path, monkeypatch):
    monkeypatch.setattr("controlmm.io.npz._MAX_BYTES", 1 << 20)
    saved(padding=np.zeros(1 << 18))(path)
    with pytest.raises(ValueError, match="it unpacks to 2098"):
        NpzFormat.load(path)


def test_truncated_file_is_refused_at_any_length(controlled_walking, path):
    NpzFormat.save(controlled_walking, path)
    whole = path.read_bytes()
    for share in (0.01, 0.3, 0.7, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ValueError, match="damaged or not a NumPy archive"):
            NpzFormat.load(path)


def test_flipped_bytes_in_the_data_are_noticed(walking, path):
    NpzFormat.save(walking, path)
    whole = bytearray(path.read_bytes())
    for at in range(200, 2000, 90):
        whole[at] ^= 0xFF
    path.write_bytes(bytes(whole))
    with pytest.raises(ValueError, match="damaged or not a NumPy archive"):
        NpzFormat.load(path)
