"""Trains one stage of a model: reads the data, has the stage's recipe built, runs the loop."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from controlmm.data.clip import FeatureClip
from controlmm.data.folder import MotionFolder
from controlmm.nn.checkpoint import CONFIG_FILE, WEIGHTS_FILE, read_config
from controlmm.text import TextEncoder
from controlmm.training.changes import with_changes
from controlmm.training.loop import Recipe, train
from controlmm.training.registry import load_stage
from controlmm.training.stage import Stage, StageInputs, best_weights
from controlmm.training.starting import adopt_earlier_stages, load_starting_weights, starting_folder


def train_stage(
    name: str,
    *,
    data: str | Path,
    size: str,
    root: str | Path,
    text_encoder: TextEncoder | None = None,
    changes: dict[str, Any] | None = None,
    options: Mapping[str, str] | None = None,
    start_from: str | Path | None = None,
    progress: bool = True,
) -> Path:
    """Train one stage into ``root/<name>`` or go on where it was stopped. Returns the run folder.

    Args:
        name: A stage of :mod:`controlmm.training.registry`; the stages that it needs must be in ``root``.
        data: A HumanML3D-style folder with train and val lists.
        size: ``small``, ``paper`` or ``tiny``.
        root: Folder of all stages of one model.
        text_encoder: Needed by stages that use text; its features are cached beside the data.
        changes: Fields of :class:`TrainingSettings` to override.
        options: Fields of the network's configuration or of the stage's own options to change, written as on
            the command line: ``{"masks": "cross"}``.
        start_from: Train given weights further: a network's folder, or the folder of a whole model, which
            also lends the earlier stages that ``root`` lacks (they are copied there). The network keeps its
            configuration; ``size`` then only names the settings.
        progress: Show progress bars.

    Raises:
        FileNotFoundError: If the data or an earlier stage is missing.
        ValueError: If a name is unknown, the data is unusable, or ``root/<name>`` holds another run.
    """
    stage, root = load_stage(name), Path(root)
    config, settings = _of_size(stage, size)
    settings = replace(settings, **(changes or {}))
    folder = MotionFolder(data)
    start = None
    if start_from is not None:
        start = starting_folder(Path(start_from), stage)
        adopt_earlier_stages(Path(start_from), root, stage)
        config = read_config(start / CONFIG_FILE, type(config))
    parts = with_changes({"config": config, "options": stage.options}, options or {})
    config = parts["config"]
    for need in stage.needs:
        best_weights(root, need)
    if stage.uses_text and text_encoder is None:
        raise ValueError(f"`text_encoder` is needed to train {name!r}.")
    inputs = StageInputs(
        root,
        folder,
        train_clips=list(folder.clips("train", progress=progress)),
        val_clips=list(folder.clips("val", progress=progress)),
        text_encoder=text_encoder,
        options=parts["options"],
        progress=progress,
    )
    torch.manual_seed(settings.seed)  # fresh weights are a function of the seed
    recipe = stage.build(config, inputs)
    if start is not None:
        load_starting_weights(recipe.model, start)
    train(_Described(recipe, size, inputs, start, options or {}), settings, root / name, progress=progress)
    return root / name


def _of_size(stage: Stage, size: str) -> tuple[Any, Any]:
    if size not in stage.configs or size not in stage.settings:
        raise ValueError(f"Stage {stage.name!r} has no size {size!r}. Sizes: {', '.join(stage.configs)}.")
    return stage.configs[size], stage.settings[size]


class _Described:
    """A recipe that also says which clips it was given, so that a run names its data."""

    def __init__(
        self, recipe: Recipe, size: str, inputs: StageInputs, start: Path | None, options: Mapping[str, str]
    ) -> None:
        self._recipe, self._size = recipe, size
        self._start = {} if start is None else {"start_from_sha256": _file_hash(start / WEIGHTS_FILE)}
        self._options = {"options": dict(options)} if options else {}
        self._data = {
            name: {"clips": len(clips), "sha256": _hash(clips)}
            for name, clips in (("train", inputs.train_clips), ("val", inputs.val_clips))
        }
        self.model, self.loss, self.validate = recipe.model, recipe.loss, recipe.validate

    def describe(self) -> dict[str, Any]:
        return {
            **self._recipe.describe(),
            "size": self._size,
            **self._options,
            **self._start,
            "data": self._data,
        }


def _file_hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _hash(clips: Sequence[FeatureClip]) -> str:
    digest = hashlib.sha256()
    for clip in clips:
        digest.update(clip.id.encode())
        digest.update(clip.features.numpy().tobytes())
    return digest.hexdigest()
