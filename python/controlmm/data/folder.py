"""HumanML3D / KIT-ML folders: ``new_joint_vecs``, ``new_joints``, ``texts``, split lists, statistics."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from controlmm.data.clip import SPLITS, Caption, Clip, FeatureClip, parse_caption
from controlmm.motion.features import canonicalize, joints_to_features, retarget
from controlmm.motion.mirror import mirror_joints, mirror_text
from controlmm.motion.normalizer import channel_statistics
from controlmm.motion.skeleton import skeleton_of_joints
from controlmm.ops import recover_joints

CLIPS_FILE = "clips.jsonl"  # ours, beside HumanML3D's files: source, licence and caption kinds of every clip


class MotionFolder:
    """A folder in HumanML3D's layout, published or written by :func:`write_folder`.

    Raises:
        FileNotFoundError: If the folder or its feature folder is missing; the message says what was expected.
        ValueError: If its ``clips.jsonl`` is damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not (self.path / "new_joint_vecs").is_dir():
            raise FileNotFoundError(
                f"{self.path} is no HumanML3D-style folder: new_joint_vecs/ is missing. "
                "Make one with `controlmm prepare`."
            )
        self._about = self._read_about()

    def ids(self, split: str) -> list[str]:
        """Names of the clips of ``split`` (train, val, test, or any other list in the folder)."""
        listing = self.path / f"{split}.txt"
        if not listing.is_file():
            raise FileNotFoundError(f"No list of the split {split!r}: {listing} is missing.")
        return listing.read_text(encoding="utf-8").split()

    def clips(self, split: str, *, progress: bool = False) -> Iterator[FeatureClip]:
        """The clips of ``split`` in the order of its list, without those whose features hold NaN.

        Raises:
            FileNotFoundError: If the list is missing.
            ValueError: If a feature file is damaged, or its captions do not fit ``clips.jsonl``.
        """
        for name in tqdm(self.ids(split), desc=f"reading {split}", disable=not progress):
            file = self.path / "new_joint_vecs" / f"{name}.npy"
            if not file.is_file():
                continue  # HumanML3D's lists name a few clips that its archive never had
            try:
                features = torch.from_numpy(np.load(file, allow_pickle=False)).float()
            except (ValueError, EOFError, OSError, TypeError) as error:
                raise ValueError(f"{file} is not a readable .npy file: {error}") from error
            if torch.isfinite(features).all():
                about = self._about.get(name, {})
                yield FeatureClip(
                    name, features, self._captions(name, about.get("kinds")), about.get("source", "unknown")
                )

    def _captions(self, name: str, kinds: list[str] | None) -> tuple[Caption, ...]:
        file = self.path / "texts" / f"{name}.txt"
        if not file.is_file():
            return ()
        lines = [line for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]
        kinds = kinds or ["annotator"] * len(lines)
        if len(kinds) != len(lines):
            raise ValueError(
                f"{file} has {len(lines)} captions, but {CLIPS_FILE} says {len(kinds)}. "
                f"Prepare the folder again, or remove {CLIPS_FILE} to read the captions without their kinds."
            )
        return tuple(parse_caption(line, kind) for line, kind in zip(lines, kinds, strict=True))

    def _read_about(self) -> dict[str, dict[str, Any]]:
        file = self.path / CLIPS_FILE
        if not file.is_file():
            return {}
        try:
            records = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
            return {record["id"]: record for record in records}
        except (json.JSONDecodeError, KeyError, TypeError) as error:
            raise ValueError(f"{file} is damaged ({error!r}). Prepare the folder again.") from error


def write_folder(
    clips: Iterable[Clip],
    path: str | Path,
    *,
    mirror: bool = True,
    retarget_bones: bool = False,
    canonical: bool = False,
    public_quirks: bool = True,
    progress: bool = True,
) -> int:
    """Write ``clips`` in HumanML3D's layout; returns the number of clips written (mirrored ones included).

    Args:
        clips: Joint positions, see :class:`Clip`.
        path: Is made; files of the same name are replaced.
        mirror: Also write every clip with left and right swapped, as ``M<id>``, its captions mirrored too.
        retarget_bones: Give all clips the reference body's bone lengths first.
        canonical: The clips already stand on the ground at the origin facing +Z: leave their placement alone.
        public_quirks: See :func:`controlmm.motion.features.joints_to_features`.
        progress: Show a progress bar.

    Raises:
        ValueError: If a clip has undefined features, a name that is taken or no plain file name, or a caption
            that a text file cannot hold (empty, several lines, a ``#``); the message names the clip.
    """
    path = Path(path)
    for folder in ("new_joint_vecs", "new_joints", "texts"):
        (path / folder).mkdir(parents=True, exist_ok=True)
    splits: dict[str, list[str]] = {split: [] for split in SPLITS}
    about: list[dict[str, Any]] = []
    taken: set[str] = set()
    for clip in tqdm(clips, desc="preparing", unit="clip", disable=not progress):
        try:
            joints = _placed(clip, retarget_bones=retarget_bones, canonical=canonical)
            for version in [clip, _mirrored(clip)] if mirror else [clip]:
                _check_writable(version, taken)
                placed = joints if version is clip else mirror_joints(joints)
                _write_clip(path, version, joints_to_features(placed, public_quirks=public_quirks))
                splits.setdefault(clip.split, []).append(version.id)
                kinds = [caption.kind for caption in clip.captions]
                about.append(
                    {"id": version.id, "source": clip.source, "licence": clip.licence, "kinds": kinds}
                )
        except ValueError as error:
            raise ValueError(f"Clip {clip.id}: {error}") from error
    for split, names in {**splits, "all": [record["id"] for record in about]}.items():
        (path / f"{split}.txt").write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    (path / CLIPS_FILE).write_text("".join(json.dumps(record) + "\n" for record in about), encoding="utf-8")
    _write_statistics(path)
    return len(about)


def _check_writable(clip: Clip, taken: set[str]) -> None:
    """HumanML3D's lists hold a name a line, its text files a caption a line with ``#`` before the tags."""
    if not re.fullmatch(r"[^\s/\\]+", clip.id):
        raise ValueError(f"`id` must be a file name without white space, got {clip.id!r}.")
    if clip.id in taken:
        raise ValueError(f"Two clips have the `id` {clip.id!r} (mirrored clips get an M before theirs).")
    taken.add(clip.id)
    for caption in clip.captions:
        if not caption.text.strip() or "#" in caption.text or len(caption.text.splitlines()) != 1:
            raise ValueError(
                f"A caption must be one line of text without '#', got {caption.text!r}. Change or drop it."
            )


def _placed(clip: Clip, *, retarget_bones: bool, canonical: bool) -> torch.Tensor:
    joints = clip.joints
    if retarget_bones:
        joints = retarget(joints, skeleton_of_joints(joints.shape[1]).rest_offsets())
    return joints if canonical else canonicalize(joints)


def _mirrored(clip: Clip) -> Clip:
    captions = tuple(Caption(mirror_text(c.text), c.kind, c.start, c.end) for c in clip.captions)
    return Clip(f"M{clip.id}", clip.joints, captions, clip.source, clip.licence, clip.split)


def _write_clip(path: Path, clip: Clip, features: torch.Tensor) -> None:
    joints = recover_joints(features[None], joints=clip.joints.shape[1])[0]
    np.save(path / "new_joint_vecs" / f"{clip.id}.npy", features.numpy())
    np.save(path / "new_joints" / f"{clip.id}.npy", joints.numpy())
    lines = [f"{caption.text}##{caption.start}#{caption.end}\n" for caption in clip.captions]
    (path / "texts" / f"{clip.id}.txt").write_text("".join(lines), encoding="utf-8")


def _write_statistics(path: Path) -> None:
    """Mean.npy and Std.npy of the training split alone, so that nothing of test enters a model."""
    names = (path / "train.txt").read_text(encoding="utf-8").split()
    if not names:
        return
    features = (torch.from_numpy(np.load(path / "new_joint_vecs" / f"{name}.npy")) for name in names)
    mean, std = channel_statistics(features)
    np.save(path / "Mean.npy", mean.float().numpy())
    np.save(path / "Std.npy", std.float().numpy())
