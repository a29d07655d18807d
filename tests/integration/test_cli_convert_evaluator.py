"""``controlmm convert-evaluator``: what it prints and refuses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path


def test_a_missing_checkpoint_is_one_line(refused: Callable[..., str], tmp_path: Path) -> None:
    message = refused(
        "convert-evaluator", tmp_path / "finest.tar", "--statistics", tmp_path, "--words", tmp_path,
        "--out", tmp_path / "out",
    )  # fmt: skip
    assert message == f"error: No checkpoint at {tmp_path / 'finest.tar'}.\n"
    assert not (tmp_path / "out").exists()
