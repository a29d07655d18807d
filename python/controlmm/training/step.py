"""One optimiser step: losses of this process's shards of the batch, summed gradients, codebook averages."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch
from torch.nn.attention import SDPBackend, sdpa_kernel

from controlmm.nn.quantizer import EmaCodebook
from controlmm.training.processes import Processes
from controlmm.training.recipe import Recipe
from controlmm.training.settings import TrainingSettings

_log = logging.getLogger(__name__)
_SHARD_STRIDE = 1_000_000_007  # between the seeds of a step's shards
_MAX_FIRST_BATCHES = 100  # to fill all codebooks; quantise dropout leaves some out of a batch


class StepTaker:
    """Takes a recipe's optimiser steps; holds the optimiser.

    Raises:
        ValueError: If the shards of a batch cannot be shared among the processes.
    """

    def __init__(self, recipe: Recipe, settings: TrainingSettings, team: Processes) -> None:
        self._recipe, self._settings, self._team = recipe, settings, team
        self._shards = team.share_of(settings.shards)
        self._parameters = [p for p in recipe.model.parameters() if p.requires_grad]
        self._codebooks = [m for m in recipe.model.modules() if isinstance(m, EmaCodebook)]
        for book in self._codebooks:
            book.is_deferred = True
        self._device_type = self._parameters[0].device.type
        self.optimizer = torch.optim.AdamW(
            self._parameters,
            lr=settings.learning_rate,
            betas=settings.betas,
            weight_decay=settings.weight_decay,
            fused=True,
        )

    def initialize_codebooks(self) -> None:
        """Let codebooks that are still empty take vectors of a first batch, the same in every process."""
        for attempt in range(1, _MAX_FIRST_BATCHES + 1):
            if all(book.is_initialized for book in self._codebooks):
                break
            torch.manual_seed(self._settings.seed - attempt)
            self._recipe.model.train()
            with torch.no_grad(), self._computing():
                self._recipe.loss(self._settings.batch_size)
        for book in self._codebooks:
            book.forget_pending()

    def take(self, step: int) -> dict[str, float]:
        """Take step ``step`` (0-based); returns what to log.

        A step whose gradient is not finite changes nothing, codebooks included.
        """
        rate = self._settings.learning_rate_at(step)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        losses = self._backward(step)
        norm = torch.nn.utils.clip_grad_norm_(self._parameters, self._settings.clip_norm or math.inf)
        if torch.isfinite(norm):
            self.optimizer.step()
            self._update_codebooks()
        else:
            _log.warning("Step %d: the gradient is not finite; the step is left out.", step + 1)
        for book in self._codebooks:
            book.forget_pending()
        return {"step": step + 1, "rate": rate, "gradient_norm": float(norm), **losses}

    def _backward(self, step: int) -> dict[str, float]:
        """Gradients and mean losses over the whole batch, all processes' shards included."""
        model, count = self._recipe.model, self._settings.shards
        totals: dict[str, torch.Tensor] = {}
        model.train()
        for shard in self._shards:
            torch.manual_seed(self._settings.seed * 1_000_003 + step + shard * _SHARD_STRIDE)
            with self._computing():
                losses = self._recipe.loss(self._settings.batch_size)
            (losses["loss"] / count).backward()
            for name, value in losses.items():
                share = value.detach().float() / count
                totals[name] = totals[name] + share if name in totals else share
        if count > 1:
            for parameter in self._parameters:
                if parameter.grad is None:  # unused in these shards, perhaps not in another process's
                    parameter.grad = torch.zeros_like(parameter)
        self._team.sum_([p.grad for p in self._parameters if p.grad is not None])
        self._team.sum_(list(totals.values()))
        return {name: float(value) for name, value in totals.items()}

    def _update_codebooks(self) -> None:
        for book in self._codebooks:
            pending = book.pending()
            self._team.copy_from_first_(pending.rows, has_one=bool(pending.batches > 0))
            self._team.sum_([pending.count, pending.total, pending.batches])
            book.apply_update(pending)

    @contextmanager
    def _computing(self) -> Iterator[None]:
        """Mixed precision; on a CPU plain attention, quicker than the tiled one for short sequences."""
        with ExitStack() as contexts:
            contexts.enter_context(
                torch.autocast(self._device_type, dtype=torch.bfloat16, enabled=self._settings.bf16)
            )
            if self._device_type == "cpu":
                contexts.enter_context(sdpa_kernel(SDPBackend.MATH))
            yield
