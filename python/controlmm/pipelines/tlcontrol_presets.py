"""Named trade-offs between time and control error for TLControl."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from controlmm.generation.trajectory_objective import LOSS_FORMS, LossForm
from controlmm.motion.body_parts import part_index

FootForm = Literal["contact", "published", "none"]
_FOOT_FORMS = ("contact", "published", "none")
PAPER_ITERATIONS = 1000


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@dataclass(frozen=True)
class TLControlPreset:
    """How codes are drawn and optimised.

    Attributes:
        tolerance: The paper's "accuracy": a clip's L-BFGS ends when its loss (half a mean square, m^2), its
            largest step or its slope changes by less. At 1e-6 trajectories are met to about a centimetre.
        iterations: Most L-BFGS steps of a clip; the released code's 1000. 0 leaves the codes as predicted.
        temperature: Of the codes; 0 takes the most likely ones, as the paper does, and then all samples are
            alike.
        guidance_scale: How strongly the text counts; 1 is the paper's.
        rate: First trial step of every line search; the released code's is 0.1.
        history: Pairs that L-BFGS remembers.
        loss: Form of the control loss, see :func:`trajectory_objective`.
        foot: What keeps feet from sliding: resting feet stay where they are (``contact``), the released
            code's term (``published``), or nothing, as the paper has it (``none``).
        vary: Only this body part differs between samples; ``None``: all do.
    """

    tolerance: float = 1e-6
    iterations: int = PAPER_ITERATIONS
    temperature: float = 1.0
    guidance_scale: float = 1.0
    rate: float = 1.0
    history: int = 200
    loss: LossForm = "half_square"
    foot: FootForm = "contact"
    vary: str | None = None

    def __post_init__(self) -> None:
        for name in ("tolerance", "rate"):
            value = getattr(self, name)
            if not _is_number(value) or not value > 0:
                raise ValueError(f"`{name}` must be a positive number, got {value!r}.")
        for name, least in (("iterations", 0), ("history", 1)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"`{name}` must be a whole number of at least {least}, got {value!r}.")
        if not _is_number(self.temperature) or self.temperature < 0:
            raise ValueError(f"`temperature` must be a number of at least 0, got {self.temperature!r}.")
        if not _is_number(self.guidance_scale):
            raise ValueError(f"`guidance_scale` must be a finite number, got {self.guidance_scale!r}.")
        for name, known in (("loss", LOSS_FORMS), ("foot", _FOOT_FORMS)):
            value = getattr(self, name)
            if value not in known:
                raise ValueError(f"`{name}` must be one of {', '.join(known)}, got {value!r}.")
        if self.vary is not None:
            part_index(self.vary)


TLCONTROL_PRESETS = {
    "fast": TLControlPreset(tolerance=1e-5),
    "balanced": TLControlPreset(),
    "accurate": TLControlPreset(tolerance=1e-8),
    "paper": TLControlPreset(temperature=0.0, rate=0.1, loss="smooth_l1", foot="published"),
}


def resolve_tlcontrol_preset(
    preset: str | TLControlPreset, *, guidance_scale: float | None = None
) -> TLControlPreset:
    """``preset`` itself, or the one of that name; with another ``guidance_scale`` if one is given.

    Raises:
        TypeError: If it is neither.
        ValueError: If there is none of that name, or the scale is no number.
    """
    if isinstance(preset, str):
        if preset not in TLCONTROL_PRESETS:
            raise ValueError(f"Unknown `preset` {preset!r}. Use one of: {', '.join(TLCONTROL_PRESETS)}.")
        preset = TLCONTROL_PRESETS[preset]
    if not isinstance(preset, TLControlPreset):
        raise TypeError(f"`preset` must be a name or a TLControlPreset, got {type(preset).__name__}.")
    return preset if guidance_scale is None else replace(preset, guidance_scale=guidance_scale)
