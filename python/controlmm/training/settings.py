"""What a training run is told: sizes, schedule, seed."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class TrainingSettings:
    """Everything about a run but the network and the data."""

    steps: int  # optimiser steps
    batch_size: int  # clips or windows in a shard
    shards: int = 1  # a step's batch is this many times `batch_size`; processes share the shards
    learning_rate: float = 2e-4
    warmup: int = 2000  # steps of linear warm-up
    milestones: tuple[int, ...] = ()  # steps at which the rate falls by `gamma`; empty: cosine decay to 1 %
    gamma: float = 0.1
    weight_decay: float = 0.0
    betas: tuple[float, float] = (0.9, 0.99)
    clip_norm: float = 1.0  # gradient norm; 0 turns clipping off, as the published training has it
    bf16: bool = True  # autocast; float32 master weights
    validate_every: int = 500
    checkpoint_every: int = 250
    average_decay: float = 0.0  # of the weights' moving average, which is then validated and kept; 0: none
    patience: int = 0  # validations without a better score after which the run ends; 0: never
    seed: int = 3407

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "shards", "validate_every", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"`{name}` must be at least 1, got {getattr(self, name)}.")
        if self.patience < 0:
            raise ValueError(f"`patience` must be 0 (never) or a number of validations, got {self.patience}.")
        if not 0 <= self.average_decay < 1:
            raise ValueError(f"`average_decay` must be in [0, 1), such as 0.999, got {self.average_decay}.")
        if not self.learning_rate > 0:
            raise ValueError(f"`learning_rate` must be positive, got {self.learning_rate}.")

    def learning_rate_at(self, step: int) -> float:
        """Rate of step ``step`` (0-based): warm-up, then milestones (published) or cosine decay (ours)."""
        if step < self.warmup:
            return self.learning_rate * (step + 2) / (self.warmup + 1)
        if self.milestones:
            return self.learning_rate * self.gamma ** sum(step >= milestone for milestone in self.milestones)
        progress = (step - self.warmup) / max(1, self.steps - self.warmup)
        return self.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, progress))))


# Of stages that need nothing of their own to be tried in seconds.
TINY = TrainingSettings(
    steps=20, batch_size=8, learning_rate=1e-3, warmup=2, validate_every=10, checkpoint_every=5, bf16=False
)
