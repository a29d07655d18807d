"""Every script of ``examples/`` runs, on a tiny model, and writes a file of every sort that it speaks of."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
QUICK = {"six_prompts": ["--preset", "fast", "--out", "out"]}  # further arguments, so that a test stays short


@pytest.mark.parametrize("script", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_example_writes_its_files(script: Path, tiny_pipeline_folder: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, script, "--model", tiny_pipeline_folder, *QUICK.get(script.stem, [])],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    written = list((tmp_path / "out").iterdir())
    assert written
    assert all(file.stat().st_size > 0 for file in written)
