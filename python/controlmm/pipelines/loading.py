"""Loads a pipeline of whatever kind a folder holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from controlmm.pipelines import folder as files
from controlmm.pipelines.controlmm import ControlMM
from controlmm.pipelines.pipeline import MotionPipeline
from controlmm.pipelines.tlcontrol import TLControl
from controlmm.text import TextEncoder


def load_pipeline(
    path: str | Path | None = None, *, text_encoder: TextEncoder | None = None
) -> MotionPipeline[Any]:
    """The pipeline in a folder, or one that comes with the package, by name (``controlmm``, ``tlcontrol``).

    Raises:
        FileNotFoundError: If the folder or one of its files is missing.
        ValueError: If the folder holds an unknown kind of pipeline, or a file is damaged.
    """
    folder = files.resolve_folder(path)
    kind = files.read_json(folder / files.PIPELINE_FILE).get("kind")
    if kind == TLControl.kind:
        return TLControl.from_pretrained(folder, text_encoder=text_encoder)
    return ControlMM.from_pretrained(folder, text_encoder=text_encoder)
