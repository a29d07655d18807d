"""Runs every code block of the documents, in order, in one folder for each document.

A comment above a block says what is particular to it: ``file: NAME`` (the block is that file),
``not run: WHY``, ``needs the model``. JSON and CSV blocks must be readable control files.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from published_layout import SMALL, write_published

from controlmm.controls import load_controls
from controlmm.pipelines.folder import PIPELINE_FILE, SHIPPED, shipped_folder

ROOT = Path(__file__).parents[2]
DOCUMENTS = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")))
CLIP_FRAMES = 70  # training windows take 64

_BLOCK = re.compile(r"(?:<!--(?P<note>[^>]*)-->\n)?```(?P<language>\w+)\n(?P<text>.*?)```", re.DOTALL)
# What would take minutes or install something, and what a test runs in its place.
_QUICKER = (
    (re.compile(r"^python3 -m venv .*&& (?=\.venv/bin/controlmm)"), ""),
    (re.compile(r"\.venv/bin/"), ""),
    (re.compile(r"--preset accurate"), "--preset fast"),
    (re.compile(r'preset="balanced"'), 'preset="fast"'),
    (
        re.compile(r"(controlmm train .*)--config small"),
        r"\1--config tiny --text hashing --steps 2 --batch-size 2",
    ),
)


@dataclass(frozen=True)
class Block:
    """One fenced block."""

    document: Path
    line: int
    language: str
    text: str
    note: str

    def __str__(self) -> str:
        return f"{self.document.name}:{self.line}"

    @property
    def quick_text(self) -> str:
        text = self.text
        for slow, quick in _QUICKER:
            text = slow.sub(quick, text)
        return text


def _blocks(document: Path) -> list[Block]:
    content = document.read_text(encoding="utf-8")
    return [
        Block(document, content.count("\n", 0, found.start("text")) + 1, found["language"], found["text"],
              (found["note"] or "").strip())
        for found in _BLOCK.finditer(content)
    ]  # fmt: skip


BLOCKS = [block for document in DOCUMENTS for block in _blocks(document)]


@pytest.fixture(scope="module")
def folder_of(
    tmp_path_factory: pytest.TempPathFactory, walk: Callable[..., torch.Tensor]
) -> Callable[[Path], Path]:
    """Where a document runs: its ``file:`` blocks, the examples, a few clips, published checkpoints."""
    made: dict[Path, Path] = {}

    def folder(document: Path) -> Path:
        if document not in made:
            made[document] = tmp_path_factory.mktemp(document.stem)
            (made[document] / "examples").symlink_to(ROOT / "examples")
            _write_clips(made[document] / "joints", walk)
            write_published(made[document] / "checkpoints" / "t2m", SMALL)
            for block in _blocks(document):
                if block.note.startswith("file: "):
                    (made[document] / block.note.removeprefix("file: ")).write_text(block.text)
        return made[document]

    return folder


def _write_clips(folder: Path, walk: Callable[..., torch.Tensor]) -> None:
    folder.mkdir()
    for name, turn in (("stand", 0.0), ("left", 0.9), ("right", -0.9), ("held_out", 0.4)):
        np.save(folder / f"{name}.npy", walk(CLIP_FRAMES, turn=turn).numpy())
        (folder / f"{name}.txt").write_text("a person walks\nsomeone takes a few steps\n")
    (folder / "val.txt").write_text("held_out\n")


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language in ("bash", "python")], ids=str)
def test_code_runs(block: Block, folder_of: Callable[[Path], Path], done_in: dict[Path, set[Block]]) -> None:
    """A block may need what those before it made; another process may have run them, in its own folder."""
    reason = _why_not(block)
    if reason:
        pytest.skip(reason)
    folder = folder_of(block.document)
    done = done_in.setdefault(folder, set())
    for earlier in _blocks(block.document):
        is_code = earlier.language in ("bash", "python") and not _why_not(earlier)
        if is_code and earlier.line <= block.line and earlier not in done:
            _run(earlier, folder)
            done.add(earlier)


@pytest.fixture(scope="module")
def done_in() -> dict[Path, set[Block]]:
    """Blocks that have run in a folder."""
    return {}


def _why_not(block: Block) -> str:
    """Why a block is not run; empty if it is."""
    if block.note.startswith("not run: "):
        return block.note.removeprefix("not run: ")
    model = SHIPPED["tlcontrol" if block.note == "needs the model tlcontrol" else "controlmm"]
    has_model = (shipped_folder(model) / PIPELINE_FILE).is_file()
    if block.note.startswith("needs the model") and not has_model:
        return "the trained model is not in this installation"
    return ""


def _run(block: Block, folder: Path) -> None:
    interpreter = [sys.executable, "-c"] if block.language == "python" else ["bash", "-euo", "pipefail", "-c"]
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    done = subprocess.run(
        [*interpreter, block.quick_text],
        cwd=folder,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{block}\n{block.quick_text}\n{done.stdout}\n{done.stderr}"


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language in ("json", "csv")], ids=str)
def test_control_files_are_readable(block: Block, tmp_path: Path) -> None:
    file = tmp_path / f"block.{block.language}"
    file.write_text(block.text)
    document = load_controls(file)
    assert document.controls or document.obstacles or document.timeline


def test_every_document_and_language_is_covered() -> None:
    assert {block.language for block in BLOCKS} == {"bash", "python", "json", "csv", "bibtex", "text"}
    assert len([block for block in BLOCKS if block.document.name == "README.md"]) >= 8
    fences = sum(document.read_text(encoding="utf-8").count("\n```") for document in DOCUMENTS)
    assert fences == 2 * len(BLOCKS)
