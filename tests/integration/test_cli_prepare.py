"""``controlmm prepare``: from joints and packs to a folder that training reads."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from controlmm.cli.prepare import SHIPPABLE_SOURCES
from controlmm.data import MotionFolder, read_joint_folder
from controlmm.motion.features import canonicalize
from controlmm.motion.skeleton import HUMANML3D

Command = Callable[..., str]
UNIT = 1e-4  # metres; packs store joints relative to the root as whole multiples of it
HANGING = np.array([0.0, 0.25, 0.0])  # metres above the floor, as on a ladder: must stay so
SAME_YAW = 1e-3  # radians a frame


@pytest.fixture
def pack_folder(joint_folder: Path, tmp_path: Path) -> Path:
    """One pack of one clip for each source, among them one that the shipped model may not use."""
    folder = tmp_path / "packs"
    folder.mkdir()
    records = []
    for source, clip in zip((*SHIPPABLE_SOURCES, "hdm05"), read_joint_folder(joint_folder), strict=False):
        joints = canonicalize(clip.joints).numpy() + HANGING
        relative = np.round((joints[:, 1:] - joints[:, :1]) / UNIT).astype(np.int16)
        members = {"ids": np.array([clip.id]), "offsets": np.array([0, len(joints)])}
        np.savez(folder / f"{source}.npz", **members, root=joints[:, 0], rel=relative, rel_unit=UNIT)
        records.append(
            {"id": clip.id, "file": f"{source}.npz", "source": source, "licence": "test", "split": "train",
             "captions": ["a person turns left"], "caption_kinds": ["written"]}
        )  # fmt: skip
    (folder / "captions.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    return folder


def _sources(data: Path) -> set[str]:
    return {clip.source for clip in MotionFolder(data).clips("train")}


def test_joints_become_a_folder_with_mirrored_clips_and_splits(
    command: Command, joint_folder: Path, tmp_path: Path
) -> None:
    printed = command("prepare", "--joints", joint_folder, "--out", tmp_path / "data", "--quiet")
    assert printed.splitlines() == [
        f"{tmp_path / 'data'}: 16 clips, mirrored ones included",
        "recorded clips of each split: train 6, val 2, test 0",
    ]
    data = MotionFolder(tmp_path / "data")
    assert data.ids("val") == ["clip6", "Mclip6", "clip7", "Mclip7"]
    clips = {clip.id: clip for clip in data.clips("train")}
    assert clips["clip0"].captions[1].text == "someone raises the left hand 0"
    assert clips["Mclip0"].captions[1].text == "someone raises the right hand 0"
    assert clips["clip0"].features.shape == (69, 263)


def test_clips_that_training_leaves_out_are_said(
    joint_folder: Path, command: Command, tmp_path: Path
) -> None:
    walk = np.load(joint_folder / "clip0.npy")
    for name, frames, caption in (("long", 201, "walks"), ("short", 40, "walks"), ("silent", 60, "")):
        np.save(tmp_path / f"{name}.npy", np.resize(walk, (frames, 22, 3)))
        if caption:
            (tmp_path / f"{name}.txt").write_text(caption)
    with pytest.warns(UserWarning, match="No clip is for validation") as said:
        command("prepare", "--joints", tmp_path, "--out", tmp_path / "data", "--quiet")
    none_to_validate, silent, odd = (str(warning.message) for warning in said)
    assert none_to_validate.startswith("No clip is for validation")
    assert silent.startswith("1 of 3 clips have no caption")
    assert odd.startswith("2 of 3 clips do not have 40 to 199 frames")


def test_centimetres_are_refused(joint_folder: Path, refused: Command, tmp_path: Path) -> None:
    np.save(tmp_path / "giant.npy", 100 * np.load(joint_folder / "clip0.npy"))
    message = refused("prepare", "--joints", tmp_path, "--out", tmp_path / "data", "--quiet")
    assert _matches(r"giant\.npy: a shin is 4\d(\.\d)? m long. Joints must be in metres", message)


def test_packs_give_only_the_sources_that_may_be_published(
    command: Command, pack_folder: Path, tmp_path: Path
) -> None:
    command("prepare", "--packs", pack_folder, "--out", tmp_path / "a", "--no-mirror", "--quiet")
    assert _sources(tmp_path / "a") == set(SHIPPABLE_SOURCES)
    command("prepare", "--packs", pack_folder, "--out", tmp_path / "b", "--sources", "all", "--quiet")
    assert _sources(tmp_path / "b") == {*SHIPPABLE_SOURCES, "hdm05"}
    command("prepare", "--packs", pack_folder, "--out", tmp_path / "c", "--sources", "cmu,hdm05", "--quiet")
    assert _sources(tmp_path / "c") == {"cmu", "hdm05"}


def test_packs_are_canonical_already_and_keep_their_place(
    command: Command, pack_folder: Path, joint_folder: Path, tmp_path: Path
) -> None:
    command("prepare", "--packs", pack_folder, "--out", tmp_path / "data", "--quirks", "--quiet")
    expected = canonicalize(next(iter(read_joint_folder(joint_folder))).joints)[:-1].numpy() + HANGING
    stored = np.load(tmp_path / "data" / "new_joints" / "clip0.npy")
    np.testing.assert_allclose(stored, expected, rtol=0, atol=2 * UNIT)


def test_quirks_are_off_unless_asked_for(command: Command, joint_folder: Path, tmp_path: Path) -> None:
    def yaw(name: str, *options: str) -> np.ndarray:
        command("prepare", "--joints", joint_folder, "--out", tmp_path / name, "--quiet", *options)
        names = MotionFolder(tmp_path / name).ids("train")
        return np.array([np.load(tmp_path / name / "new_joint_vecs" / f"{n}.npy")[0, 0] for n in names])

    right, published = yaw("a"), yaw("b", "--quirks")
    np.testing.assert_array_equal(right, yaw("c", "--no-quirks"))
    # The quirk forces the first heading to +Z, so what smoothing changed of it shows as a jump to frame 1.
    assert not np.allclose(published, right, atol=SAME_YAW)


def test_retargeting_gives_the_reference_bones(command: Command, joint_folder: Path, tmp_path: Path) -> None:
    command("prepare", "--joints", joint_folder, "--out", tmp_path / "data", "--retarget", "--quiet")
    joints = np.load(tmp_path / "data" / "new_joints" / "clip0.npy")
    shin = np.linalg.norm(joints[:, 8] - joints[:, 5], axis=-1)
    np.testing.assert_allclose(shin, HUMANML3D.bone_lengths[8], atol=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "Pass either `--packs` or `--joints`"),
        (["--packs", "nowhere"], "No folder at nowhere"),
        (["--joints", "nowhere"], "No folder at nowhere"),
        (["--joints", ".", "--sources", "cmu"], "`--sources` chooses among packs"),
        (["--packs", ".", "--sources", ","], "`--sources` is empty"),
    ],
)
def test_bad_arguments_write_nothing(
    arguments: list[str], message: str, refused: Command, tmp_path: Path
) -> None:
    assert message in refused("prepare", *arguments, "--out", tmp_path / "data")
    assert not (tmp_path / "data").exists()


def test_an_unknown_source_lists_the_known_ones(refused: Command, pack_folder: Path, tmp_path: Path) -> None:
    arguments = ("--packs", pack_folder, "--sources", "amass", "--out", tmp_path / "data", "--quiet")
    assert "has no source amass. It has: bandai_namco, cmu, cmu_dance, hdm05" in refused(
        "prepare", *arguments
    )


def _matches(pattern: str, message: str) -> bool:
    return re.search(pattern, message) is not None
