"""``controlmm info`` and what every command shares: quick help, no needless imports."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import controlmm
from controlmm.cli.info import count_parameters
from controlmm.nn.checkpoint import read_weights
from controlmm.ops import build_info

Command = Callable[..., str]
COMMANDS = ("generate", "info", "controls", "prepare", "train", "plot", "assemble", "convert")


def _lines(printed: str) -> dict[str, str]:
    pairs = (line.split("  ", 1) for line in printed.splitlines())
    return {name: value.strip() for name, value in pairs}


def test_info_tells_the_build_and_the_weights(command: Command, tiny_pipeline_folder: Path) -> None:
    lines = _lines(command("info", "--model", tiny_pipeline_folder))
    assert lines["version"] == build_info().version
    assert lines["instruction set"].split()[0] == (build_info().isa or "-")
    assert lines["threads"] == str(build_info().threads)
    assert lines["weights"] == str(tiny_pipeline_folder)
    assert lines["text encoder"] == "hashing (needs no weights)"
    files = list(tiny_pipeline_folder.rglob("*.safetensors"))
    assert len(files) == 5
    size = sum(file.stat().st_size for file in files) / 1e6
    count = sum(value.numel() for file in files for value in read_weights(file).values()) / 1e6
    assert lines["size"] == f"{size:.1f} MB, {count:.2f} million parameters"


def test_info_works_without_a_model_folder(command: Command) -> None:
    assert _lines(command("info"))["version"] == build_info().version


def test_info_names_damaged_weights(refused: Command, tiny_pipeline_folder: Path, tmp_path: Path) -> None:
    weights = tmp_path / "model.safetensors"
    weights.write_bytes((tiny_pipeline_folder / "control" / "model.safetensors").read_bytes()[:50])
    with pytest.raises(ValueError, match=r"model\.safetensors is damaged or truncated"):
        count_parameters(weights)
    assert "No model folder" in refused("info", "--model", tmp_path / "missing")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help(name: str, command: Command) -> None:
    assert "Usage" in command(name, "--help")


def test_help_does_not_load_torch() -> None:
    code = (
        "import sys; from controlmm.cli.main import app; app(['--help'], standalone_mode=False); "
        "sys.exit(sorted({'torch', 'numpy', 'matplotlib', 'tokenizers'} & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert all(name in done.stdout for name in COMMANDS)


def test_the_installed_command_prints_one_line_for_an_error(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "controlmm", "generate", "--controls", "missing.json"],
        capture_output=True, text=True, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: No control file at missing.json.\n"


def test_the_version_is_the_one_of_the_kernels() -> None:
    if build_info().compiler is None:
        pytest.skip("the native extension is not built")
    assert build_info().version == controlmm.__version__
