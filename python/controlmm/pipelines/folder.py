"""A pipeline on disk: one folder a network, statistics, and what text encoder it was trained with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

PIPELINE_FILE, TEXT_ENCODER_FILE = "pipeline.json", "text_encoder.json"
NORMALIZER_FILE = "normalizer.safetensors"
FORMAT = 1
# The models in the wheel: name that a caller may give instead of a folder -> folder in `pretrained`.
SHIPPED = {"controlmm": "small", "tlcontrol": "tlcontrol"}


def shipped_folder(name: str = SHIPPED["controlmm"]) -> Path:
    """Folder of a trained model that comes with the package."""
    return Path(__file__).resolve().parents[1] / "pretrained" / name


def resolve_folder(path: str | Path | None, *, shipped: str = "controlmm") -> Path:
    """The folder to load: ``path``, or a shipped model for its name; ``None`` is the name ``shipped``.

    Raises:
        FileNotFoundError: If there is no such folder, or it holds no pipeline.
    """
    name = shipped if path is None else str(path)
    folder = Path(name) if Path(name).is_dir() or name not in SHIPPED else shipped_folder(SHIPPED[name])
    if not folder.is_dir():
        raise FileNotFoundError(
            f"No model folder at {folder}. Pass one that `controlmm assemble` or `save_pretrained` wrote, or "
            f"the name of a model that comes with the package: {', '.join(SHIPPED)}."
        )
    if not (folder / PIPELINE_FILE).is_file():
        raise FileNotFoundError(
            f"{folder} holds no pipeline: {PIPELINE_FILE} is missing. Train one with `controlmm train` and "
            "put it together with `controlmm assemble`."
        )
    return folder


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is broken or no object.
    """
    if not path.is_file():
        raise FileNotFoundError(f"No {path.name} in {path.parent}.")
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is broken JSON: {error}.") from error
    if not isinstance(value, dict):
        raise ValueError(f"{path} must hold a JSON object, got {type(value).__name__}.")
    return value


def read_pipeline(folder: Path, kind: str) -> dict[str, Any]:
    """What a pipeline's folder says about it.

    Raises:
        FileNotFoundError: If it says nothing.
        ValueError: If it does not hold a pipeline of ``kind`` in a format that we read.
    """
    about = read_json(folder / PIPELINE_FILE)
    if about.get("kind") != kind or about.get("format") != FORMAT:
        raise ValueError(
            f"{folder} holds a pipeline of kind {about.get('kind')!r}, format {about.get('format')!r}; "
            f"expected {kind!r}, format {FORMAT}. `controlmm.pipelines.load_pipeline` opens every kind."
        )
    return about


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write a JSON object, indented."""
    path.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")
