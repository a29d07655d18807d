"""The training loop that every recipe shares.

Every step draws all its randomness (batch, dropout, noise) from ``(seed, step)``. So a run that was killed
and resumed takes the same steps as one that was never stopped.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor
from tqdm import tqdm

from controlmm.nn.checkpoint import PretrainedModel
from controlmm.training.run_folder import RunFolder
from controlmm.training.settings import TrainingSettings

_log = logging.getLogger(__name__)
_MAX_BAD_STEPS = 20  # consecutive steps with a gradient that is not finite; then the run is beyond help


class Recipe(Protocol):
    """What is particular to one network."""

    @property
    def model(self) -> PretrainedModel:
        """The network in training."""

    def loss(self, batch_size: int) -> dict[str, Tensor]:
        """Losses of one fresh random batch; the entry ``loss`` is minimised, the others are logged."""

    def validate(self) -> dict[str, float]:
        """Metrics on the validation split; ``score`` decides which weights are kept (lower is better)."""

    def describe(self) -> dict[str, Any]:
        """What identifies the run: data list, hashes, options."""


def train(
    recipe: Recipe,
    settings: TrainingSettings,
    run: str | Path,
    *,
    progress: bool = True,
    on_validation: Callable[[int], None] | None = None,
) -> PretrainedModel:
    """Train until ``settings.steps``; resumes by itself when ``run`` holds a checkpoint. Returns the network.

    The weights with the best validation score lie in ``<run>/best`` (``config.json``, ``model.safetensors``).

    Raises:
        ValueError: If ``run`` holds another run, or the loss stops being finite.
    """
    folder = RunFolder(run)
    described = {"settings": dataclasses.asdict(settings), **recipe.describe()}
    folder.write_settings(described)
    model = recipe.model
    parameters = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(
        parameters, lr=settings.learning_rate, betas=settings.betas, weight_decay=settings.weight_decay
    )
    done, best = folder.load_checkpoint(model, optimizer) if folder.has_checkpoint else (0, None)
    folder.forget_after(done)
    bar = tqdm(total=settings.steps, initial=done, desc=folder.path.name, unit="step", disable=not progress)
    bad_steps = 0
    for step in range(done, settings.steps):
        record = _take_step(recipe, settings, optimizer, parameters, step)
        bad_steps = 0 if math.isfinite(record["gradient_norm"]) else bad_steps + 1
        if bad_steps >= _MAX_BAD_STEPS:
            raise ValueError(
                f"The gradient was not finite for {_MAX_BAD_STEPS} steps up to step {step + 1}. "
                "Lower the learning rate; the last good checkpoint is kept."
            )
        bar.update()
        if (step + 1) % 10 == 0:
            folder.log(record)
            bar.set_postfix(loss=f"{record['loss']:.4g}", refresh=False)
        last = step + 1 == settings.steps
        if (step + 1) % settings.validate_every == 0 or last:
            best = _validate(recipe, folder, step + 1, best)
            if on_validation is not None:
                on_validation(step + 1)
        is_healthy = bad_steps == 0  # a batch that is not finite may have spoilt the codebooks' averages
        if is_healthy and ((step + 1) % settings.checkpoint_every == 0 or last):
            folder.save_checkpoint(model, optimizer, step + 1, best)
    bar.close()
    return model


def _take_step(
    recipe: Recipe,
    settings: TrainingSettings,
    optimizer: torch.optim.Optimizer,
    parameters: list[torch.nn.Parameter],
    step: int,
) -> dict[str, float]:
    torch.manual_seed(settings.seed * 1_000_003 + step)
    rate = settings.learning_rate_at(step)
    for group in optimizer.param_groups:
        group["lr"] = rate
    recipe.model.train()
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=settings.bf16):
        losses = recipe.loss(settings.batch_size)
    optimizer.zero_grad(set_to_none=True)
    losses["loss"].backward()
    norm = torch.nn.utils.clip_grad_norm_(parameters, settings.clip_norm or math.inf)
    if torch.isfinite(norm):
        optimizer.step()
    else:
        _log.warning("Step %d: the gradient is not finite; the step is left out.", step + 1)
    values = {name: float(value.detach()) for name, value in losses.items()}
    return {"step": step + 1, "rate": rate, "gradient_norm": float(norm), **values}


def _validate(recipe: Recipe, folder: RunFolder, step: int, best: float | None) -> float | None:
    recipe.model.eval()
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(0)  # the same draws at every validation, so that scores compare
        metrics = recipe.validate()
    folder.log({"step": step, **{f"val_{name}": value for name, value in metrics.items()}})
    _log.info("step %d: %s", step, ", ".join(f"{name} {value:.4g}" for name, value in metrics.items()))
    if math.isfinite(metrics["score"]) and (best is None or metrics["score"] < best):
        recipe.model.save_pretrained(folder.path / "best")
        return metrics["score"]
    return best
