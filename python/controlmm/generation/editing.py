"""How much editing there is, of logits and of latents, and by which means."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

EditingOptimizer = Literal["adamw", "gradient"]
LatentSolver = Literal["papers", "auto", "gauss-newton", "lbfgs"]


@dataclass(frozen=True)
class EditingBudget:
    """How editing looks for latents, and how long.

    Attributes:
        observes_targets: Whether each decoding step looks where targets want the tokens that are drawn, see
            ``generation.observed_logits``; not where there are other terms.
        solver: "papers" takes the optimiser and the rates below; "gauss-newton", "lbfgs", or "auto", which
            chooses between them, need no rates.
        tolerance: Metres. A clip is done when it is this near its targets.
        time_budget: Seconds for the latents of a batch. Results then depend on the speed of the machine.
        naturalness: Strength of the terms that keep latent editing natural, see ``generation.naturalness``;
            0 leaves them out, 1 is what was chosen on validation clips.
    """

    logits_iterations: int = 0  # in each decoding step
    logits_iterations_grow: bool = False  # step k takes k times as many: the published command's default, 35
    logits_rate: float = 0.06  # of logits editing
    observes_targets: bool = False
    latent_iterations: int = 100  # after the last decoding step
    latent_rate: float = 0.05  # of latent editing, in standard deviations of the base codes
    decays_rate: bool = True  # cosine decay of the latents' rate to zero; the papers keep it constant
    optimizer: EditingOptimizer = "adamw"  # published code; "gradient": plain steps, as the paper writes it

    solver: LatentSolver = "papers"  # of latents
    tolerance: float | None = None
    time_budget: float | None = None
    naturalness: float = 0.0

    def __post_init__(self) -> None:
        if min(self.logits_iterations, self.latent_iterations) < 0:
            raise ValueError(f"Iterations must not be negative, got {self}.")
        if self.logits_iterations and self.observes_targets:
            raise ValueError(
                "Logits are edited or observed: set `logits_iterations` to 0 or `observes_targets` to False, "
                f"got {self}."
            )
        for name in ("logits_rate", "latent_rate"):
            if not getattr(self, name) > 0:
                raise ValueError(f"`{name}` must be positive, got {getattr(self, name)}.")
        if self.optimizer not in get_args(EditingOptimizer):
            raise ValueError(
                f"`optimizer` must be one of {get_args(EditingOptimizer)}, got {self.optimizer!r}."
            )

        if self.solver not in get_args(LatentSolver):
            raise ValueError(f"`solver` must be one of {get_args(LatentSolver)}, got {self.solver!r}.")
        if not (math.isfinite(self.naturalness) and self.naturalness >= 0):
            raise ValueError(f"`naturalness` must be a number of at least 0, got {self.naturalness!r}.")
        for name in ("tolerance", "time_budget"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"`{name}` must be a positive number or None, got {value!r}.")

    def logits_iterations_in(self, step: int) -> int:
        """Gradient steps on the logits in decoding step ``step``, counted from 0."""
        return self.logits_iterations * (step + 1 if self.logits_iterations_grow else 1)
