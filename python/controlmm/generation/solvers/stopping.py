"""When a solver leaves a clip alone, and what it hands back."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

Reason = Literal[
    "target met",  # the error asked for, or a loss of exactly zero
    "iterations",  # the solver's own steps are used up
    "evaluations",  # of the objective, used up
    "time",  # the budget in milliseconds is spent
    "converged",  # no step is left that changes anything
]


@dataclass(frozen=True)
class Stopping:
    """Limits, whichever comes first, for each clip by itself; ``None`` sets none.

    Attributes:
        error: Metres. A clip is done when its objective's ``errors()`` say that it is this near its targets.
        iterations: Steps of the solver.
        evaluations: Evaluations of the objective, the first one at the starting point included.
        milliseconds: Wall-clock time for the whole batch. Results then depend on the speed of the machine.
    """

    error: float | None = None
    iterations: int | None = None
    evaluations: int | None = None
    milliseconds: float | None = None

    def __post_init__(self) -> None:
        for name in ("error", "milliseconds"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"`{name}` must be a positive number or None, got {value!r}.")
        for name, least in (("iterations", 0), ("evaluations", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"`{name}` must be at least {least} or None, got {value!r}.")
        if self.iterations is None and self.evaluations is None and self.milliseconds is None:
            raise ValueError(
                "A solver needs a limit that it always reaches: set `iterations`, `evaluations` or "
                "`milliseconds`; `error` alone may be out of reach."
            )


class Watch:
    """Judges clips by a :class:`Stopping`, from the moment it is made."""

    def __init__(self, stopping: Stopping, *, clock: Callable[[], float] = time.perf_counter) -> None:
        self._stopping, self._clock = stopping, clock
        self._start = clock()

    def verdict(self, *, loss: float, error: float | None, evaluations: int) -> Reason | None:
        """Why a clip stops after this evaluation; ``None`` if it goes on."""
        limits = self._stopping
        if loss == 0 or (limits.error is not None and error is not None and error <= limits.error):
            return "target met"
        if limits.evaluations is not None and evaluations >= limits.evaluations:
            return "evaluations"
        if limits.milliseconds is not None and self.seconds * 1000 >= limits.milliseconds:
            return "time"
        return None

    @property
    def seconds(self) -> float:
        """Since the start."""
        return self._clock() - self._start


@dataclass(frozen=True, eq=False)
class Solution:
    """What a solver found.

    Attributes:
        latents: (B, L, C), the best iterate of every clip.
        losses: (E,) for every clip, the objective at each of its evaluations.
        errors: (E,) for every clip, metres: its distance to the targets at each of its evaluations; empty
            where the objective knows no distance.
        evaluations: (B,), how many there were.
        reasons: Why each clip stopped.
        seconds: Wall-clock time of the whole batch.
        iterations: (B,), steps that were taken, where the solver has steps of several evaluations.
    """

    latents: Float[Tensor, "B L C"]
    losses: tuple[Float[Tensor, "E"], ...]
    errors: tuple[Float[Tensor, "E"], ...]
    evaluations: Int[Tensor, "B"]
    reasons: tuple[Reason, ...]
    seconds: float
    iterations: Int[Tensor, "B"] | None = None

    def then(self, second: Solution) -> Solution:
        """One that went on from here, with the histories of both."""
        losses, errors = (
            tuple(torch.cat(pair) for pair in zip(*both, strict=True))
            for both in ((self.losses, second.losses), (self.errors, second.errors))
        )
        return Solution(
            second.latents,
            losses,
            errors,
            self.evaluations + second.evaluations,
            second.reasons,
            self.seconds + second.seconds,
            self.iterations + second.iterations
            if self.iterations is not None and second.iterations is not None
            else None,
        )
