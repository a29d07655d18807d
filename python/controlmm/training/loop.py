"""The training loop that every recipe shares.

Every step draws all its randomness (batch, dropout, noise) from ``(seed, step, shard of the batch)``. So a
run that was killed and resumed takes the same steps as one that was never stopped, and a run on several
processes the same as one on a single process.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from tqdm import tqdm

from controlmm.nn.checkpoint import PretrainedModel
from controlmm.training.averaging import WeightAverage
from controlmm.training.checkpoint import Progress, load_checkpoint, save_checkpoint
from controlmm.training.processes import Processes
from controlmm.training.provenance import provenance
from controlmm.training.recipe import Recipe
from controlmm.training.run_folder import RunFolder
from controlmm.training.settings import TrainingSettings
from controlmm.training.step import StepTaker

_log = logging.getLogger(__name__)
_MAX_BAD_STEPS = 20  # consecutive steps with a gradient that is not finite; then the run is beyond help
_LOG_EVERY = 10  # steps


def train(
    recipe: Recipe,
    settings: TrainingSettings,
    run: str | Path,
    *,
    progress: bool = True,
    on_validation: Callable[[int], None] | None = None,
    files: Mapping[str, str] | None = None,
    processes: Processes | None = None,
    device: str | torch.device = "cpu",
) -> PretrainedModel:
    """Train until ``settings.steps``; resumes by itself when ``run`` holds a checkpoint. Returns the network.

    The weights with the best validation score lie in ``<run>/best`` (``config.json``, ``model.safetensors``).
    A kill between any two writes loses at most the steps since the last checkpoint, which are taken again.

    Args:
        recipe: Network, losses, validation.
        settings: Schedule; a run is resumed only with the same.
        run: Folder of the run.
        progress: Show a progress bar.
        on_validation: Called with the number of steps after each validation, while the network still has the
            weights that were validated (the averaged ones when ``settings.average_decay`` is set).
        files: Texts to keep in the run folder, content by name.
        processes: Those that train together; by default this one alone. Only the first writes.
        device: Where the network is trained. The recipe follows the network.

    Raises:
        ValueError: If ``run`` holds another run, the loss stops being finite, or the shards of a batch cannot
            be shared among the processes.
    """
    team = processes or Processes()
    folder, device = RunFolder(run), torch.device(device)
    model = recipe.model.to(device)
    if team.is_first:
        told = {"settings": dataclasses.asdict(settings), "network": dataclasses.asdict(model.config)}
        folder.write_settings({**told, **recipe.describe()}, files)
        folder.write_start(provenance(team, device))
    taker = StepTaker(recipe, settings, team)
    average = WeightAverage(model, settings.average_decay)
    state = Progress()
    if folder.has_checkpoint:
        state = load_checkpoint(folder.checkpoint, model, taker.optimizer, average)
    if team.is_first:
        folder.forget_after(state.step)
    _run(recipe, settings, folder, taker, average, state, team, on_validation, progress=progress)
    return model


def _run(
    recipe: Recipe,
    settings: TrainingSettings,
    folder: RunFolder,
    taker: StepTaker,
    average: WeightAverage,
    state: Progress,
    team: Processes,
    on_validation: Callable[[int], None] | None,
    *,
    progress: bool,
) -> None:
    bar = tqdm(
        total=settings.steps,
        initial=state.step,
        desc=folder.path.name,
        unit="step",
        disable=not progress or not team.is_first,
    )
    if not _is_over(state, settings):
        taker.initialize_codebooks()
    started, before = time.monotonic(), state.seconds
    bad_steps = 0
    while not _is_over(state, settings):
        record = taker.take(state.step)
        state.step += 1
        is_good = math.isfinite(record["gradient_norm"])
        bad_steps = 0 if is_good else bad_steps + 1
        if is_good:
            average.update()
        if bad_steps >= _MAX_BAD_STEPS:
            raise ValueError(
                f"The gradient was not finite for {_MAX_BAD_STEPS} steps up to step {state.step}. "
                "Lower the learning rate; the last good checkpoint is kept."
            )
        bar.update()
        if state.step % _LOG_EVERY == 0 and team.is_first:
            folder.log(record)
            bar.set_postfix(loss=f"{record['loss']:.4g}", refresh=False)
        if state.step % settings.validate_every == 0 or state.step == settings.steps:
            with average.applied():
                _validate(recipe, folder, state, team, on_validation)
        is_due = state.step % settings.checkpoint_every == 0 or _is_over(state, settings)
        if bad_steps == 0 and is_due and team.is_first:
            state.updates, state.seconds = average.updates, before + time.monotonic() - started
            save_checkpoint(folder.checkpoint, state, recipe.model, taker.optimizer, average)
    bar.close()
    if team.is_first:
        _summarize(folder, state, settings)


def _is_over(state: Progress, settings: TrainingSettings) -> bool:
    return state.step >= settings.steps or bool(settings.patience and state.stale >= settings.patience)


def _validate(
    recipe: Recipe,
    folder: RunFolder,
    state: Progress,
    team: Processes,
    on_validation: Callable[[int], None] | None,
) -> None:
    """Validate, keep the weights if they are the best so far, and count how long they have been."""
    score = math.nan
    if team.is_first:
        recipe.model.eval()
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            torch.manual_seed(0)  # the same draws at every validation, so that scores compare
            metrics = recipe.validate()
        folder.log({"step": state.step, **{f"val_{name}": value for name, value in metrics.items()}})
        shown = ", ".join(f"{name} {value:.4g}" for name, value in metrics.items())
        _log.info("step %d: %s", state.step, shown)
        score = metrics["score"]
    (score,) = team.agree([score])
    if math.isfinite(score) and (state.best is None or score < state.best):
        if team.is_first:
            recipe.model.save_pretrained(folder.path / "best")
        state.best, state.best_step, state.stale = score, state.step, 0
    else:
        state.stale += 1
    if team.is_first and on_validation is not None:
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            on_validation(state.step)


def _summarize(folder: RunFolder, state: Progress, settings: TrainingSettings) -> None:
    is_early = state.step < settings.steps
    if is_early:
        _log.info("No better score in %d validations: stopped at step %d.", state.stale, state.step)
    folder.write_summary(
        {
            "steps": state.step,
            "ended": "early, no better validation score" if is_early else "all steps taken",
            "best_step": state.best_step,
            "best_score": state.best,
            "hours": round(state.seconds / 3600, 3),
        }
    )
