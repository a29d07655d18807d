"""Named trade-offs between time and control error."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from controlmm.generation.decoding_rules import DecodingRules
from controlmm.generation.editing import EditingBudget
from controlmm.ops.consistency import NORM_CODES, Norm


@dataclass(frozen=True)
class Preset:
    """How a motion is decoded and edited."""

    budget: EditingBudget
    steps: int = 10  # of masked decoding
    guidance_scale: float = 4.0
    residual_guidance_scale: float = 5.0
    control_norm: Norm = "mse"  # of the distance that editing minimises: published code; the paper: "l2"
    rules: DecodingRules = field(default_factory=DecodingRules)

    def __post_init__(self) -> None:
        if isinstance(self.steps, bool) or not isinstance(self.steps, int) or self.steps < 1:
            raise ValueError(f"`steps` must be a whole number of at least 1, got {self.steps!r}.")
        if self.control_norm not in NORM_CODES:
            raise ValueError(f"`control_norm` must be one of {tuple(NORM_CODES)}, got {self.control_norm!r}.")
        for name in ("guidance_scale", "residual_guidance_scale"):
            value = getattr(self, name)
            if not isinstance(value, int | float) or not math.isfinite(value):
                raise ValueError(f"`{name}` must be a finite number, got {value!r}.")


# Measured by `python -m benchmarks.editing`. The papers' iteration counts are there to compare with.
PRESETS = {
    "fast": Preset(EditingBudget(solver="auto", latent_iterations=10, tolerance=0.01)),
    "balanced": Preset(EditingBudget(solver="auto", latent_iterations=25, tolerance=0.003)),
    "accurate": Preset(EditingBudget(solver="auto", latent_iterations=60, tolerance=0.001)),
    "paper-fast": Preset(EditingBudget(latent_iterations=100)),
    "paper-medium": Preset(EditingBudget(latent_iterations=600)),
    "paper-accurate": Preset(EditingBudget(logits_iterations=100, latent_iterations=600)),
}


def resolve_preset(preset: str | Preset, *, guidance_scale: float | None = None) -> Preset:
    """``preset`` itself, or the one of that name; with another ``guidance_scale`` if one is given.

    Raises:
        TypeError: If it is neither.
        ValueError: If there is none of that name, or the scale is no number.
    """
    plan = _resolved(preset)
    return plan if guidance_scale is None else replace(plan, guidance_scale=guidance_scale)


def _resolved(preset: str | Preset) -> Preset:
    if isinstance(preset, Preset):
        return preset
    if not isinstance(preset, str):
        raise TypeError(f"`preset` must be a name or a Preset, got {type(preset).__name__}.")
    return preset_named(preset)


def preset_named(name: str) -> Preset:
    """The preset called ``name``.

    Raises:
        ValueError: If there is none; the message lists them.
    """
    if name not in PRESETS:
        raise ValueError(f"Unknown `preset` {name!r}. Use one of: {', '.join(PRESETS)}.")
    return PRESETS[name]
