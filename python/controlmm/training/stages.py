"""Trains one stage of a model: reads the data, has the stage's recipe built, runs the loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from controlmm.data.folder import MotionFolder
from controlmm.nn.checkpoint import CONFIG_FILE, WEIGHTS_FILE, read_config
from controlmm.text import TextEncoder
from controlmm.training.augmentation import Augmentation
from controlmm.training.changes import with_changes
from controlmm.training.level_ground import ClipSelection
from controlmm.training.loop import train
from controlmm.training.processes import Processes
from controlmm.training.provenance import clip_table, data_identity, file_hash
from controlmm.training.recipe import Recipe, Sample
from controlmm.training.registry import load_stage
from controlmm.training.stage import Stage, StageInputs, best_weights
from controlmm.training.starting import adopt_earlier_stages, load_starting_weights, starting_folder

CLIPS_FILE = "clips.tsv"  # in the run folder: which clips it saw


@dataclass(frozen=True)
class Validation:
    """A moment of a run for people to look at: the network still has the weights that were validated."""

    run: Path
    step: int
    samples: Callable[[], Sequence[Sample]]  # what the network makes of a few validation clips


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
    on_validation: Callable[[Validation], None] | None = None,
    processes: Processes | None = None,
    device: str | torch.device = "cpu",
) -> Path:
    """Train one stage into ``root/<name>`` or go on where it was stopped. Returns the run folder.

    Args:
        name: A stage of :mod:`controlmm.training.registry`; the stages that it needs must be in ``root``.
        data: A HumanML3D-style folder with train and val lists.
        size: ``small``, ``paper`` or ``tiny``.
        root: Folder of all stages of one model.
        text_encoder: Needed by stages that use text; its features are cached beside the data.
        changes: Fields of :class:`TrainingSettings` to override.
        options: Fields to change of the network's configuration, of the stage's own options, of its settings
            of :class:`controlmm.training.augmentation.Augmentation` or of
            :class:`controlmm.training.level_ground.ClipSelection`, written as on the command line:
            ``{"masks": "cross", "joined_share": "0.5"}``.
        start_from: Train given weights further: a network's folder, or the folder of a whole model, which
            also lends the earlier stages that ``root`` lacks (they are copied there). The network keeps its
            configuration; ``size`` then only names the settings.
        progress: Show progress bars.
        on_validation: Called after each validation, in the first process only.
        processes: Those that train together; by default this one alone.
        device: Where the network is trained, such as ``cpu`` or ``cuda``.

    Raises:
        FileNotFoundError: If the data or an earlier stage is missing.
        ValueError: If a name is unknown, the data is unusable, or ``root/<name>`` holds another run.
    """
    stage, root = load_stage(name), Path(root)
    if size not in stage.configs or size not in stage.settings:
        raise ValueError(f"Stage {name!r} has no size {size!r}. Sizes: {', '.join(stage.configs)}.")
    settings = replace(stage.settings[size], **(changes or {}))
    team = processes or Processes()
    config, start = stage.configs[size], None
    if start_from is not None:
        start = starting_folder(Path(start_from), stage)
        config = read_config(start / CONFIG_FILE, type(config))
    parts = {
        "config": config,
        "options": stage.options,
        "settings": settings,
        "data": Augmentation(),
        "selection": ClipSelection(),
    }
    parts = with_changes(parts, options or {})
    settings = parts["settings"]
    inputs = StageInputs(
        root,
        MotionFolder(data),
        text_encoder=text_encoder,
        options=parts["options"],
        augmentation=parts["data"],
        selection=parts["selection"],
        progress=progress,
        start=start,
        writes=team.is_first,
    )
    with team.first_goes_ahead():
        if start_from is not None and team.is_first:
            adopt_earlier_stages(Path(start_from), root, stage)
        recipe, built_on = _built(stage, parts["config"], settings.seed, inputs)
    about: dict[str, Any] = {"size": size, "built_on": built_on, **data_identity(inputs.splits)}
    if options:
        about["options"] = dict(options)

    def observe(step: int) -> None:
        if on_validation is not None:
            show = stage.samples
            on_validation(Validation(root / name, step, lambda: show(recipe, inputs) if show else ()))

    train(
        _Described(recipe, about),
        settings,
        root / name,
        progress=progress,
        on_validation=observe,
        files={CLIPS_FILE: clip_table(inputs.splits)},
        processes=team,
        device=device,
    )
    return root / name


def _built(stage: Stage, config: Any, seed: int, inputs: StageInputs) -> tuple[Recipe, dict[str, str]]:
    """The stage's recipe, and the hashes of the weights that it stands on."""
    folders = {need: best_weights(inputs.root, need) for need in stage.needs}
    if inputs.start is not None:
        folders["start_from"] = inputs.start
    if stage.uses_text and inputs.text_encoder is None:
        raise ValueError(f"`text_encoder` is needed to train {stage.name!r}.")
    torch.manual_seed(seed)  # fresh weights are a function of the seed
    recipe = stage.build(config, inputs)
    if inputs.start is not None:
        load_starting_weights(recipe.model, inputs.start)
    return recipe, {name: file_hash(folder / WEIGHTS_FILE) for name, folder in folders.items()}


class _Described:
    """A recipe that also says which clips it was given and what it stands on."""

    def __init__(self, recipe: Recipe, about: dict[str, Any]) -> None:
        self._recipe, self._about = recipe, about
        self.model, self.loss, self.validate = recipe.model, recipe.loss, recipe.validate

    def describe(self) -> dict[str, Any]:
        return {**self._recipe.describe(), **self._about}
