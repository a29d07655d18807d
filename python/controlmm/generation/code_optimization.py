"""TLControl's test-time optimisation: L-BFGS on the continuous codes in front of the frozen decoder."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.generation.foot_terms import ContactTerm, PublishedFootTerm
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.solvers import LbfgsTolerance, Progress, Solution, Stopping, lbfgs
from controlmm.generation.terms import JointTerm
from controlmm.generation.trajectory_objective import (
    LOSS_FORMS,
    LossForm,
    Rescaled,
    trajectory_objective,
)

FootForm = Literal["contact", "published", "none"]
FOOT_FORMS = ("contact", "published", "none")
PAPER_ITERATIONS = 1000
_EVALUATIONS_A_STEP = 1.25  # at most, on average: what the released code's L-BFGS may spend


@dataclass(frozen=True)
class CodeOptimization:
    """How codes are optimised.

    Attributes:
        tolerance: The paper's "accuracy": a clip's L-BFGS ends when its loss (half a mean square, m^2), its
            largest step or its slope changes by less. At 1e-6 trajectories are met to about a centimetre.
        iterations: Most L-BFGS steps of a clip; the released code's 1000. 0 leaves the codes as predicted.
        rate: First trial step of every line search; the released code's is 0.1.
        history: Pairs that L-BFGS remembers.
        loss: Form of the control loss, see :func:`trajectory_objective`.
        foot: What keeps feet from sliding: resting feet stay where they are (``contact``), the released
            code's term (``published``), or nothing, as the paper has it (``none``).
    """

    tolerance: float = 1e-6
    iterations: int = PAPER_ITERATIONS
    rate: float = 1.0
    history: int = 200
    loss: LossForm = "half_square"
    foot: FootForm = "contact"

    def __post_init__(self) -> None:
        for name in ("tolerance", "rate"):
            value = getattr(self, name)
            if not is_number(value) or not value > 0:
                raise ValueError(f"`{name}` must be a positive number, got {value!r}.")
        for name, least in (("iterations", 0), ("history", 1)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"`{name}` must be a whole number of at least {least}, got {value!r}.")
        for name, known in (("loss", LOSS_FORMS), ("foot", FOOT_FORMS)):
            value = getattr(self, name)
            if value not in known:
                raise ValueError(f"`{name}` must be one of {', '.join(known)}, got {value!r}.")


def optimize_codes(
    decoder: MotionDecoder,
    latents: Float[Tensor, "B L C"],
    valid: Bool[Tensor, "B L"],
    targets: Float[Tensor, "B T J 3"],
    mask: Bool[Tensor, "B T J 3"],
    settings: CodeOptimization,
    *,
    unit: float,
    terms: Sequence[JointTerm] = (),
    progress: Progress | None = None,
) -> Solution:
    """Latents whose motions meet their targets (section 3.3); codes are never quantised again.

    Args:
        decoder: Latents to joints.
        latents: Where to start: the predicted codes.
        valid: Tokens of each clip.
        targets: Metres, the networks' frame, padded to whole tokens.
        mask: The controlled coordinates.
        settings: Tolerance, limits and forms of the loss.
        unit: What a published latent is in these; tolerances of slopes and steps are meant there.
        terms: Minimised beside the distance.
        progress: Called after every evaluation.
    """
    frames = valid.repeat_interleave(decoder.downsample, dim=1)
    every_term = [*terms, *_foot_terms(decoder, latents, frames, mask, settings)]
    objective = trajectory_objective(settings.loss, decoder, targets, mask, frames, terms=every_term)
    solution = lbfgs(
        Rescaled(objective, unit=unit),
        latents / unit,
        valid[..., None].float(),
        Stopping(
            iterations=settings.iterations,
            evaluations=max(1, round(_EVALUATIONS_A_STEP * settings.iterations)),
        ),
        rate=settings.rate,
        history=settings.history,
        tolerance=LbfgsTolerance(change=settings.tolerance / decoder.normalizer.skeleton.metres**2),
        progress=progress,
    )
    return dataclasses.replace(solution, latents=solution.latents * unit)


def _foot_terms(
    decoder: MotionDecoder, latents: Tensor, frames: Tensor, mask: Tensor, settings: CodeOptimization
) -> list[JointTerm]:
    weight = 2.0 if settings.loss == "half_square" else 1.0  # that form halves its terms
    if settings.foot == "contact":
        return [ContactTerm.of_motion(decoder, latents, frames, mask, weight=weight)]
    if settings.foot == "published":
        return [PublishedFootTerm(frames, decoder.normalizer.skeleton, weight=weight)]
    return []


def is_number(value: object) -> bool:
    """Whether ``value`` is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
