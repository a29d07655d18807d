"""``controlmm convert``: what it prints, refuses and leaves behind."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from published_layout import JOINTS, PELVIS, RVQ, SMALL, write_published

from controlmm.models.control_branch import ControlBranch

Command = Callable[..., str]


@pytest.fixture
def published(tmp_path: Path) -> Path:
    return write_published(tmp_path / "t2m", SMALL)


def test_a_folder_is_converted_and_every_source_is_named(
    command: Command, published: Path, tmp_path: Path
) -> None:
    printed = command("convert", published, "--out", tmp_path / "model").splitlines()
    assert f"tokenizer             {published / RVQ / 'model' / 'net_best_fid.tar'}" in printed
    assert f"control               {published / JOINTS / 'model' / 'latest.tar'}" in printed
    assert any(line.startswith(f"{tmp_path / 'model'}: ") and line.endswith(" MB") for line in printed)
    assert sorted(path.name for path in (tmp_path / "model").iterdir()) == [
        "README.md", "control", "length", "normalizer.safetensors", "pipeline.json", "residual",
        "text_encoder.json", "tokenizer", "transformer",
    ]  # fmt: skip


def test_the_card_names_every_file_with_its_hash(command: Command, published: Path, tmp_path: Path) -> None:
    command("convert", published, "--out", tmp_path / "model")
    card = (tmp_path / "model" / "README.md").read_text()
    file = published / RVQ / "model" / "net_best_fid.tar"
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    assert f"| tokenizer | `{RVQ}/model/net_best_fid.tar` | `{digest}` |" in card
    assert str(tmp_path) not in card.split("- ")[0]


def test_the_pelvis_model_can_be_chosen(command: Command, published: Path, tmp_path: Path) -> None:
    printed = command("convert", published, "--out", tmp_path / "model", "--control", "pelvis")
    assert PELVIS in printed
    assert ControlBranch.from_pretrained(tmp_path / "model" / "control").config.joints == (0,)


class _Hostile:
    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[object, ...]:
        return os.system, (f"touch {self.trace}",)


def test_a_hostile_file_is_refused_in_one_line_and_nothing_is_written(
    refused: Command, published: Path, tmp_path: Path
) -> None:
    trace = tmp_path / "trace"
    file = published / JOINTS / "model" / "latest.tar"
    torch.save({"ct2m_transformer": _Hostile(trace)}, file)
    message = refused("convert", published, "--out", tmp_path / "model")
    assert message.startswith(f"error: {file} is refused: it is damaged or holds the Python object")
    assert not trace.exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["t2m"]


def test_missing_parts_are_named_in_one_line(refused: Command, published: Path, tmp_path: Path) -> None:
    (published / RVQ / "model" / "net_best_fid.tar").unlink()
    message = refused("convert", published, "--out", tmp_path / "model")
    assert message.startswith("error: No tokenizer among the checkpoints. Found: ")
    assert "rvq_*/model/net_best_fid.tar with meta/mean.npy and meta/std.npy" in message
