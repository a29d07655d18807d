"""Readers of joint positions: npz packs with a captions file, and folders of ``.npy`` files."""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from controlmm.data.clip import SPLITS, Caption, Clip, parse_caption
from controlmm.motion.skeleton import HUMANML3D

CAPTIONS_FILE = "captions.jsonl"
_SHORTEST_SHIN, _LONGEST_SHIN = 0.05, 2.0  # metres; a grown person's has 0.4
_RECORD_KEYS = {"id", "file", "source", "licence", "split", "captions", "caption_kinds"}


def read_packs(folder: Path, *, sources: Collection[str] | None = None) -> Iterator[Clip]:
    """Clips of the npz packs in ``folder``, in the order of its ``captions.jsonl``.

    Args:
        folder: Holds ``captions.jsonl`` (one JSON object a clip with ``id``, ``file``, ``source``, ``split``,
            ``licence``, ``captions``, ``caption_kinds``), and the packs it names (members ``ids``,
            ``offsets``, ``root``, ``rel``, ``rel_unit``).
        sources: Read only these sources; ``None`` reads all.

    Raises:
        FileNotFoundError: If the captions file or a pack is missing.
        ValueError: If a line or a pack is damaged, or a source does not occur.
    """
    records = _read_records(folder / CAPTIONS_FILE)
    known = {record["source"] for record in records}
    if sources is not None and not set(sources) <= known:
        unknown = sorted(set(sources) - known)
        raise ValueError(f"{folder} has no source {', '.join(unknown)}. It has: {', '.join(sorted(known))}.")
    packs: dict[str, _Pack] = {}
    for record in records:
        if sources is not None and record["source"] not in sources:
            continue
        name = record["file"]
        if name not in packs:
            packs[name] = _Pack(folder / name)
        pairs = zip(record["captions"], record["caption_kinds"], strict=True)
        captions = tuple(Caption(text, kind) for text, kind in pairs)
        yield Clip(
            record["id"],
            packs[name].joints(record["id"]),
            captions,
            record["source"],
            record["licence"],
            record["split"],
        )


def read_joint_folder(folder: Path) -> Iterator[Clip]:
    """Clips of a folder of ``NAME.npy`` joint positions (F, 22, 3), with captions in ``NAME.txt``.

    A sentence a line, plain or as HumanML3D's text files have it; captions may be missing. All clips are of
    split ``train`` unless ``val.txt`` or ``test.txt`` beside them list the name.

    Raises:
        FileNotFoundError: If the folder does not exist or holds no ``.npy`` file.
        ValueError: If a file is damaged, or its joints are not in metres.
    """
    files = sorted(folder.glob("*.npy")) if folder.is_dir() else []
    if not files:
        raise FileNotFoundError(f"No .npy files of joint positions in {folder}.")
    split_of = {name: split for split in SPLITS for name in _lines(folder / f"{split}.txt")}
    for file in files:
        try:
            joints = torch.from_numpy(np.load(file, allow_pickle=False))
        except (ValueError, EOFError, OSError, TypeError) as error:
            raise ValueError(f"{file} is not a readable .npy file: {error}") from error
        _check_unit(joints, file)
        captions = tuple(parse_caption(line) for line in _lines(file.with_suffix(".txt")))
        yield Clip(file.stem, joints, captions, source=folder.name, split=split_of.get(file.stem, "train"))


def _check_unit(joints: torch.Tensor, file: Path) -> None:
    """Refuse bodies of giants: recordings are often in centimetres, and nothing later would notice."""
    if joints.ndim != 3 or joints.shape[1:] != (HUMANML3D.num_joints, 3):
        return  # KIT-ML, or refused later
    knee, ankle = HUMANML3D.leg_bones
    shin = (joints[:, knee] - joints[:, ankle]).norm(dim=-1).median().item()
    if not _SHORTEST_SHIN < shin < _LONGEST_SHIN and math.isfinite(shin):
        raise ValueError(f"{file}: a shin is {shin:.3g} m long. Joints must be in metres.")


class _Pack:
    """One npz pack, every member unpacked once."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise FileNotFoundError(f"No pack at {path}.")
        try:
            with np.load(path, allow_pickle=False) as pack:
                members = {name: pack[name] for name in ("ids", "offsets", "root", "rel", "rel_unit")}
        except (ValueError, KeyError, EOFError, OSError, zlib.error, zipfile.BadZipFile) as error:
            raise ValueError(f"{path} is not a readable motion pack: {error}") from error
        self.path = path
        self.index = {str(name): i for i, name in enumerate(members["ids"])}
        self.offsets, self.root = members["offsets"], members["root"]
        self.relative, self.unit = members["rel"], float(members["rel_unit"])

    def joints(self, clip_id: str) -> torch.Tensor:
        if clip_id not in self.index:
            raise ValueError(f"{self.path} has no clip {clip_id!r}, which {CAPTIONS_FILE} puts there.")
        i = self.index[clip_id]
        frames = slice(self.offsets[i], self.offsets[i + 1])
        root = self.root[frames].astype(np.float64)[:, None]
        return torch.from_numpy(np.concatenate([root, root + self.relative[frames] * self.unit], axis=1))


def _read_records(path: Path) -> list[dict[str, Any]]:
    if not path.is_file():
        raise FileNotFoundError(f"No {path.name} in {path.parent}; it lists the clips and their captions.")
    records = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            record = json.loads(line)
        except json.JSONDecodeError as error:
            raise ValueError(f"{path}, line {number}: broken JSON ({error.msg}).") from error
        _check_record(record, f"{path}, line {number}")
        records.append(record)
    return records


def _check_record(record: Any, where: str) -> None:
    missing = sorted(_RECORD_KEYS - set(record)) if isinstance(record, dict) else sorted(_RECORD_KEYS)
    if missing:
        raise ValueError(f"{where}: expected a JSON object with {', '.join(missing)}.")
    captions, kinds = len(record["captions"]), len(record["caption_kinds"])
    if captions != kinds:
        raise ValueError(f"{where}: {captions} captions but {kinds} caption kinds.")


def _lines(path: Path) -> list[str]:
    if not path.is_file():
        return []
    return [line.strip() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
