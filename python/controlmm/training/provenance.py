"""Where a run comes from: version, revision, command, machine; and exactly which clips it saw."""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

import controlmm
from controlmm.data.clip import FeatureClip
from controlmm.training.processes import Processes


def provenance(processes: Processes, device: torch.device) -> dict[str, Any]:
    """What one start of a run was: time, command, versions, git revision (if this is a checkout), machine."""
    return {
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "version": controlmm.__version__,
        "revision": git_revision(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "device": str(device),
        "threads": torch.get_num_threads(),
        "processes": processes.count,
    }


def git_revision() -> str | None:
    """Commit of the checkout that this package runs from, ``-dirty`` when files differ; ``None`` elsewhere.

    A package that is installed inside somebody else's repository is no checkout: git must know this file.
    """
    file = Path(__file__)
    if _git(file.parent, "ls-files", "--error-unmatch", file.name) is None:
        return None
    revision = _git(file.parent, "rev-parse", "HEAD")
    changes = _git(file.parent, "status", "--porcelain", "--untracked-files=no")
    return f"{revision}-dirty" if changes else revision


def data_identity(splits: Mapping[str, Sequence[FeatureClip]]) -> dict[str, Any]:
    """Number of clips of each split and hashes of their names with features, and of their captions."""
    return {
        "data": {
            name: {"clips": len(clips), "sha256": _combined((c.id, _features(c)) for c in clips)}
            for name, clips in splits.items()
        },
        "captions": {
            name: _combined((c.id, "\n".join(caption.text for caption in c.captions).encode()) for c in clips)
            for name, clips in splits.items()
        },
    }


def clip_table(splits: Mapping[str, Sequence[FeatureClip]]) -> str:
    """Tab-separated table with a row for each clip: split, id, frames, SHA-256 of its float32 features."""
    rows = [
        f"{name}\t{clip.id}\t{len(clip.features)}\t{hashlib.sha256(_features(clip)).hexdigest()}\n"
        for name, clips in splits.items()
        for clip in clips
    ]
    return "split\tid\tframes\tsha256\n" + "".join(rows)


def file_hash(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _features(clip: FeatureClip) -> bytes:
    return clip.features.numpy().tobytes()


def _combined(parts: Any) -> str:
    digest = hashlib.sha256()
    for name, content in parts:
        digest.update(name.encode())
        digest.update(content)
    return digest.hexdigest()


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", *arguments],
            cwd=folder,
            env={**os.environ, "GIT_OPTIONAL_LOCKS": "0"},
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
