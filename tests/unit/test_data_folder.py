"""Writing and reading folders in HumanML3D's layout."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from controlmm.data import Caption, Clip, MotionFolder, write_folder
from controlmm.data.clip import parse_caption
from controlmm.motion.features import canonicalize, joints_to_features
from controlmm.motion.mirror import mirror_features
from controlmm.motion.normalizer import channel_statistics

MIRROR_ERROR = 2e-6  # humanml3d.md, section 6


def clip_of(walk, name: str = "a", *captions: Caption, **fields) -> Clip:
    return Clip(name, walk(50), captions or (Caption("a person walks"),), **fields)


def write(clips, path, **options) -> MotionFolder:
    write_folder(clips, path, progress=False, **options)
    return MotionFolder(path)


def test_clips_come_back_with_features_captions_and_source(walk, tmp_path):
    captions = (Caption("walks left", "written"), Caption("stops", "template", 1.5, 2.25))
    folder = write([clip_of(walk, "a", *captions, source="lab")], tmp_path, mirror=False)
    (clip,) = folder.clips("train")
    assert (clip.id, clip.source, clip.captions) == ("a", "lab", captions)
    assert torch.equal(clip.features, joints_to_features(canonicalize(walk(50))))


def test_mirrored_clips_have_mirrored_features_and_captions(walk, tmp_path):
    folder = write([clip_of(walk, "a", Caption("waves the left hand", "written", 0.5, 1.0))], tmp_path)
    clip, mirrored = folder.clips("train")
    assert mirrored.id == "Ma"
    assert mirrored.captions == (Caption("waves the right hand", "written", 0.5, 1.0),)
    torch.testing.assert_close(mirrored.features, mirror_features(clip.features), rtol=0, atol=MIRROR_ERROR)


def test_splits_are_listed_and_statistics_are_those_of_train_alone(walk, tmp_path):
    clips = [
        clip_of(walk, name, split=split) for name, split in (("a", "train"), ("b", "val"), ("c", "test"))
    ]
    folder = write(clips, tmp_path, mirror=False)
    assert [folder.ids(split) for split in ("train", "val", "test", "all")] == [
        ["a"],
        ["b"],
        ["c"],
        ["a", "b", "c"],
    ]
    mean, std = channel_statistics(clip.features for clip in folder.clips("train"))
    np.testing.assert_array_equal(np.load(tmp_path / "Mean.npy"), mean.float().numpy())
    np.testing.assert_array_equal(np.load(tmp_path / "Std.npy"), std.float().numpy())


def test_joints_beside_the_features_are_the_decoded_ones(walk, tmp_path):
    write([clip_of(walk)], tmp_path)
    joints = np.load(tmp_path / "new_joints" / "a.npy")
    np.testing.assert_allclose(joints, canonicalize(walk(50))[:-1].numpy(), rtol=0, atol=1e-5)


def test_canonical_clips_keep_their_place(walk, tmp_path):
    lifted = canonicalize(walk(50)) + torch.tensor([0.0, 0.25, 0.0])
    (clip,) = write([Clip("a", lifted, ())], tmp_path, canonical=True, mirror=False).clips("train")
    assert clip.features[0, 3] == lifted[0, 0, 1]


def test_retargeted_clips_have_the_reference_size(walk, tmp_path):
    (clip,) = write([Clip("a", 1.3 * walk(50), ())], tmp_path, retarget_bones=True, mirror=False).clips(
        "train"
    )
    expected = joints_to_features(canonicalize(walk(50)))
    torch.testing.assert_close(clip.features[:, :67], expected[:, :67], rtol=0, atol=1e-5)


@pytest.mark.parametrize("text", ["uses the #1 move", "first line\nsecond", "a\u2028b", "  ", ""])
def test_captions_that_a_text_file_cannot_hold_are_refused(walk, tmp_path, text):
    with pytest.raises(ValueError, match="Clip a: A caption must be one line of text without '#'"):
        write([clip_of(walk, "a", Caption(text))], tmp_path)


@pytest.mark.parametrize("name", ["a b", "a/b", "../a", ""])
def test_names_that_are_no_file_names_are_refused(walk, tmp_path, name):
    with pytest.raises(ValueError, match="`id` must be a file name without white space"):
        write([clip_of(walk, name)], tmp_path)


def test_names_that_are_taken_are_refused(walk, tmp_path):
    with pytest.raises(ValueError, match="Two clips have the `id` 'Ma'"):
        write([clip_of(walk, "a"), clip_of(walk, "Ma")], tmp_path)


def test_a_clip_without_features_is_named(walk, tmp_path):
    joints = walk(50)
    joints[20] = 0
    with pytest.raises(ValueError, match="Clip broken: The pose of frame 20"):
        write([clip_of(walk), Clip("broken", joints, ())], tmp_path)


@pytest.mark.parametrize(
    ("line", "caption"),
    [
        (
            "a person walks.#a/DET person/NOUN walk/VERB#0.0#0.0",
            Caption("a person walks.", tokens=("a/DET", "person/NOUN", "walk/VERB")),
        ),
        (
            "he turns#he/PRON turn/VERB#2.5#4.0",
            Caption("he turns", start=2.5, end=4.0, tokens=("he/PRON", "turn/VERB")),
        ),
        ("he turns#he/PRON turn/VERB#nan#nan", Caption("he turns", tokens=("he/PRON", "turn/VERB"))),
        ("he turns#he/PRON turn/VERB", Caption("he turns", tokens=("he/PRON", "turn/VERB"))),
        ("he turns", Caption("he turns")),
        ("he turns##x#1", Caption("he turns", start=0.0, end=1.0)),
    ],
)
def test_published_text_lines_are_understood(line, caption):
    assert parse_caption(line) == caption


def test_a_published_folder_without_our_file_is_read(walk, tmp_path):
    folder = write([clip_of(walk)], tmp_path, mirror=False)
    (tmp_path / "clips.jsonl").unlink()
    (clip,) = MotionFolder(folder.path).clips("train")
    assert (clip.source, clip.captions[0].kind) == ("unknown", "annotator")


def test_listed_clips_that_are_missing_or_nan_are_left_out(walk, tmp_path):
    folder = write([clip_of(walk, "a"), clip_of(walk, "b"), clip_of(walk, "c")], tmp_path, mirror=False)
    (tmp_path / "new_joint_vecs" / "a.npy").unlink()
    features = np.load(tmp_path / "new_joint_vecs" / "b.npy")
    features[3, 3] = np.nan
    np.save(tmp_path / "new_joint_vecs" / "b.npy", features)
    assert [clip.id for clip in folder.clips("train")] == ["c"]


def test_missing_folder_list_and_damaged_files_are_named(walk, tmp_path):
    with pytest.raises(FileNotFoundError, match="no HumanML3D-style folder: new_joint_vecs/ is missing"):
        MotionFolder(tmp_path / "nowhere")
    folder = write([clip_of(walk)], tmp_path, mirror=False)
    with pytest.raises(FileNotFoundError, match="No list of the split 'dev'"):
        folder.ids("dev")
    file = tmp_path / "new_joint_vecs" / "a.npy"
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(ValueError, match=r"a\.npy is not a readable \.npy file"):
        list(folder.clips("train"))


def test_damaged_or_foreign_clip_records_are_named(walk, tmp_path):
    write([clip_of(walk)], tmp_path, mirror=False)
    record = json.loads((tmp_path / "clips.jsonl").read_text())
    (tmp_path / "clips.jsonl").write_text(json.dumps({**record, "kinds": ["a", "b"]}) + "\n")
    with pytest.raises(ValueError, match=r"a\.txt has 1 captions, but clips\.jsonl says 2"):
        list(MotionFolder(tmp_path).clips("train"))
    (tmp_path / "clips.jsonl").write_text('{"id": "a"')
    with pytest.raises(ValueError, match=r"clips\.jsonl is damaged"):
        MotionFolder(tmp_path)
