"""Finds published checkpoints: run folders of ``opt.txt``, ``meta/`` and ``model/*.tar``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from controlmm.convert.options_file import OptionValue, read_options
from controlmm.convert.torch_file import StateDict, find_state_dict, read_torch_file


@dataclass(frozen=True)
class _Role:
    keys: tuple[str, ...]  # under which the file holds the state dict: today's, then older ones
    files: tuple[str, ...]  # the authors' choice first


ROLES = {
    "tokenizer": _Role(("vq_model", "net"), ("net_best_fid.tar", "latest.tar")),
    "masked transformer": _Role(("t2m_transformer", "trans"), ("latest.tar", "net_best_fid.tar")),
    "residual transformer": _Role(("res_transformer",), ("net_best_fid.tar", "latest.tar")),
    "control": _Role(("ct2m_transformer",), ("latest.tar", "net_best_acc.tar")),
    "length estimator": _Role(("estimator",), ("finest.tar", "latest.tar")),
}


@dataclass(frozen=True)
class Checkpoint:
    """One network's file."""

    role: str
    folder: Path  # the run folder
    file: Path
    state: StateDict  # published names
    options: dict[str, OptionValue]


def find_checkpoints(paths: Sequence[Path]) -> tuple[list[Checkpoint], list[Path]]:
    """Checkpoints in ``paths``: ``.tar`` files, run folders, or folders of run folders.

    Returns:
        The checkpoints, and the files that hold no network known here (such as the evaluator's).

    Raises:
        FileNotFoundError: If a path does not exist, or no checkpoint is found anywhere.
        ValueError: If a file holds anything but tensors and plain values, or is damaged.
    """
    found, others = [], []
    for path in paths:
        for files in _candidates(path):
            checkpoint = _read_best(files)
            if checkpoint is None:
                others.append(files[0])
            else:
                found.append(checkpoint)
    if not found:
        raise FileNotFoundError(
            f"No published checkpoint in {', '.join(map(str, paths))}. Expected run folders that hold "
            "model/*.tar, such as rvq_nq6_dc512_nc512_noshare_qdp0.2/model/net_best_fid.tar."
        )
    return found, others


def _candidates(path: Path) -> Iterable[list[Path]]:
    """Files of each run, of which one is to be taken."""
    if path.is_file():
        return [[path]]
    if not path.is_dir():
        raise FileNotFoundError(f"No file or folder at {path}.")
    runs = (
        [path]
        if (path / "model").is_dir()
        else sorted(folder for folder in path.iterdir() if folder.is_dir())
    )
    return [files for run in runs if (files := sorted((run / "model").glob("*.tar")))]


def _read_best(files: list[Path]) -> Checkpoint | None:
    """The file that its role prefers among those of one run."""
    for file in files:
        checkpoint = _read(file)
        if checkpoint is None:
            continue
        for name in ROLES[checkpoint.role].files:
            preferred = file.with_name(name)
            if preferred in files:
                return checkpoint if preferred == file else _read(preferred)
        return checkpoint
    return None


def _read(file: Path) -> Checkpoint | None:
    loaded = read_torch_file(file)
    folder = file.parent.parent
    for role, about in ROLES.items():
        state = find_state_dict(loaded, about.keys)
        if state is not None:
            return Checkpoint(role, folder, file, state, read_options(folder))
    return None
