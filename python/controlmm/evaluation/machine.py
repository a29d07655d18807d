"""What a result was measured with and on, in words."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path

import torch

from controlmm import __version__
from controlmm.ops import active_isa

_CPU_FILE = Path("/proc/cpuinfo")


def machine() -> str:
    """Processor, cores, threads, instruction set of the kernels, and versions; no names of machines."""
    return (
        f"{_processor()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads, "
        f"kernels {active_isa() or 'in plain torch'}, Python {platform.python_version()}, "
        f"torch {torch.__version__}, {platform.system()}"
    )


def revision() -> str:
    """Version of the package and, in a checkout, the commit; ``+`` when files differ from it."""
    folder = Path(__file__).parent
    try:
        described = subprocess.run(
            ["git", "-C", str(folder), "describe", "--always", "--dirty=+", "--exclude=*"],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return __version__
    return f"{__version__} at {described}"


def _processor() -> str:
    if _CPU_FILE.is_file():
        for line in _CPU_FILE.read_text(encoding="utf-8").splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return " ".join(value.split())
    return platform.processor() or platform.machine()
