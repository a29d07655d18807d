"""Readers of joint positions: npz packs and folders of .npy files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from controlmm.data import Caption, read_joint_folder, read_packs

UNIT = 1e-4  # metres; the packs hold offsets to the root as integers
RECORD = {
    "id": "b",
    "file": "lab.npz",
    "source": "lab",
    "licence": "CC0-1.0",
    "split": "val",
    "captions": ["one", "two"],
    "caption_kinds": ["written", "kinematic"],
}


def write_pack(folder: Path, walk, *records: dict) -> np.ndarray:
    """A pack of clips ``a`` (7 frames) and ``b`` (5 frames); returns all joints."""
    joints = walk(12).numpy()
    np.savez(
        folder / "lab.npz",
        ids=np.array(["a", "b"]),
        offsets=np.array([0, 7, 12]),
        root=joints[:, 0].astype(np.float32),
        rel=np.round((joints[:, 1:] - joints[:, :1]) / UNIT).astype(np.int16),
        rel_unit=np.array(UNIT),
    )
    lines = [json.dumps(record) + "\n" for record in records or [RECORD]]
    (folder / "captions.jsonl").write_text("".join(lines), encoding="utf-8")
    return joints


def test_a_clip_is_cut_out_of_its_pack(walk, tmp_path):
    joints = write_pack(tmp_path, walk)
    (clip,) = read_packs(tmp_path)
    np.testing.assert_allclose(clip.joints.numpy(), joints[7:], rtol=0, atol=UNIT)
    assert (clip.id, clip.source, clip.licence, clip.split) == ("b", "lab", "CC0-1.0", "val")
    assert clip.captions == (Caption("one", "written"), Caption("two", "kinematic"))


def test_sources_are_chosen_and_unknown_ones_refused(walk, tmp_path):
    write_pack(tmp_path, walk, RECORD, {**RECORD, "id": "a", "source": "field"})
    assert [clip.id for clip in read_packs(tmp_path, sources=["field"])] == ["a"]
    with pytest.raises(ValueError, match=r"has no source moon\. It has: field, lab"):
        list(read_packs(tmp_path, sources=["moon", "lab"]))


def test_missing_files_are_named(walk, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"No captions\.jsonl in"):
        list(read_packs(tmp_path))
    write_pack(tmp_path, walk)
    (tmp_path / "lab.npz").unlink()
    with pytest.raises(FileNotFoundError, match=r"No pack at .*lab\.npz"):
        list(read_packs(tmp_path))


@pytest.mark.parametrize("keep", [0, 100, -200])
def test_a_damaged_pack_is_named(walk, tmp_path, keep):
    write_pack(tmp_path, walk)
    file = tmp_path / "lab.npz"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(ValueError, match=r"lab\.npz is not a readable motion pack"):
        list(read_packs(tmp_path))


def test_a_pack_without_a_member_is_named(walk, tmp_path):
    write_pack(tmp_path, walk)
    np.savez(tmp_path / "lab.npz", ids=np.array(["a"]))
    with pytest.raises(ValueError, match=r"lab\.npz is not a readable motion pack: .*offsets"):
        list(read_packs(tmp_path))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('{"id": "b",', r"captions\.jsonl, line 2: broken JSON"),
        ("[1, 2]", r"line 2: expected a JSON object with .*caption_kinds"),
        (
            json.dumps({"id": "b", "file": "lab.npz"}),
            r"line 2: expected a JSON object with caption_kinds, captions",
        ),
        (json.dumps({**RECORD, "captions": ["one"]}), r"line 2: 1 captions but 2 caption kinds"),
        (json.dumps({**RECORD, "id": "z"}), r"lab\.npz has no clip 'z'"),
    ],
)
def test_damaged_lines_are_named(walk, tmp_path, line, message):
    write_pack(tmp_path, walk, RECORD)
    with (tmp_path / "captions.jsonl").open("a", encoding="utf-8") as file:
        file.write(line + "\n")
    with pytest.raises(ValueError, match=message):
        list(read_packs(tmp_path))


def test_a_folder_of_joint_files_is_read_with_captions_and_splits(walk, tmp_path):
    for name in ("a", "b"):
        np.save(tmp_path / f"{name}.npy", walk(9).numpy())
    (tmp_path / "a.txt").write_text("walks\n\nstops#stop/VERB#1.0#2.0\n", encoding="utf-8")
    (tmp_path / "val.txt").write_text("b\n", encoding="utf-8")
    first, second = read_joint_folder(tmp_path)
    assert torch.equal(first.joints, walk(9))
    assert first.captions == (Caption("walks"), Caption("stops", start=1.0, end=2.0, tokens=("stop/VERB",)))
    assert (first.split, second.split, second.captions) == ("train", "val", ())


def test_an_empty_folder_and_a_damaged_file_are_named(tmp_path):
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(FileNotFoundError, match=r"No \.npy files of joint positions in"):
            list(read_joint_folder(folder))
    (tmp_path / "a.npy").write_bytes(b"no array")
    with pytest.raises(ValueError, match=r"a\.npy is not a readable \.npy file"):
        list(read_joint_folder(tmp_path))


def test_the_real_packs_hold_what_their_readme_says(shared):
    clips = read_packs(shared / "data", sources=["hdm05"])
    first = next(clips)
    assert first.joints.shape[1:] == (22, 3)
    assert first.joints[0, 0, [0, 2]].abs().max() < 1e-6
    assert 1 + sum(1 for _ in clips) == 115
