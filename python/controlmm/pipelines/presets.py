"""Named trade-offs between time and control error."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from controlmm.generation.decoding_rules import DecodingRules
from controlmm.generation.editing import EditingBudget
from controlmm.ops.consistency import NORM_CODES, Norm

_LENGTHS = {"m": 1.0, "mm": 0.001, "cm": 0.01}
_TIMES = {"s": 1.0, "ms": 0.001}
_FEW_STEPS = 6  # of masked decoding; on validation clips no worse than the papers' ten (docs/solvers.md)


@dataclass(frozen=True)
class Preset:
    """How a motion is decoded and edited."""

    budget: EditingBudget
    steps: int = 10  # of masked decoding
    guidance_scale: float | None = None  # None: what suits the model
    residual_guidance_scale: float | None = None
    guided_share: float | None = None  # of the steps, the first ones
    control_norm: Norm = "mse"  # of the distance that editing minimises: published code; the paper: "l2"
    rules: DecodingRules = field(default_factory=DecodingRules)
    # Metres: latents are edited until so near, then joints are put on their targets in closed form, and bones
    # get their lengths (controlmm.generation.exact). None: latents as near as the budget says, nothing after.
    closes_from: float | None = None
    is_exact: bool = False  # what bones cannot span is refused, and obstacles do not keep joints off targets
    is_bfloat16: bool = False  # networks that draw tokens multiply in bfloat16 where the processor has AMX

    def __post_init__(self) -> None:
        if isinstance(self.steps, bool) or not isinstance(self.steps, int) or self.steps < 1:
            raise ValueError(f"`steps` must be a whole number of at least 1, got {self.steps!r}.")
        if self.control_norm not in NORM_CODES:
            raise ValueError(f"`control_norm` must be one of {tuple(NORM_CODES)}, got {self.control_norm!r}.")
        for name in ("guidance_scale", "residual_guidance_scale"):
            value = getattr(self, name)
            is_number = isinstance(value, int | float) and math.isfinite(value)
            if value is not None and not is_number:
                raise ValueError(f"`{name}` must be a finite number, got {value!r}.")
        share = self.guided_share
        if share is not None and not (isinstance(share, int | float) and 0 <= share <= 1):
            raise ValueError(f"`guided_share` must be from 0 to 1, got {share!r}.")
        near = self.closes_from
        if near is not None and not (isinstance(near, int | float) and 0 < near < math.inf):
            raise ValueError(f"`closes_from` must be a positive number of metres or None, got {near!r}.")
        if self.is_exact and near is None:
            raise ValueError("`is_exact` needs `closes_from`: joints come onto targets in closed form.")

    def closes(self, *, has_terms: bool) -> bool:
        """Whether joints are put on their targets at the end.

        ``has_terms``: beside obstacles or objectives, which nobody watches then.
        """
        return self.closes_from is not None and (self.is_exact or not has_terms)

    def latent_budget(self, *, has_terms: bool) -> EditingBudget:
        """Of the latents: until it is near enough, if the rest is done in closed form."""
        if has_terms or not self.closes(has_terms=has_terms):
            return self.budget
        return replace(self.budget, tolerance=self.closes_from)


def _edited(
    iterations: int,
    tolerance: float,
    *,
    near: float,
    guided_share: float | None = None,
    is_exact: bool = False,
) -> Preset:
    """Tokens drawn with an eye on the targets; latents edited with naturalness until ``near``; a closed end.

    Until ``tolerance`` where there is no closed end.
    """
    budget = EditingBudget(
        observes_targets=True,
        solver="auto",
        latent_iterations=iterations,
        tolerance=tolerance,
        naturalness=1.0,
    )
    return Preset(
        budget,
        steps=_FEW_STEPS,
        guided_share=guided_share,
        closes_from=near,
        is_exact=is_exact,
        is_bfloat16=True,
    )


def _papers(*, logits: int = 0, codebook: int) -> Preset:
    """The papers' iterations; guidance in all steps."""
    return Preset(EditingBudget(logits_iterations=logits, latent_iterations=codebook), guided_share=1.0)


# `python -m benchmarks.editing` measures them. The papers' iteration counts are there to compare with.
PRESETS = {
    "fast": _edited(20, 0.01, near=0.07),
    "balanced": _edited(40, 0.003, near=0.03),
    "accurate": _edited(80, 0.001, near=0.02, guided_share=1.0),
    "exact": _edited(80, 0.001, near=0.01, guided_share=1.0, is_exact=True),
    "paper-fast": _papers(codebook=100),
    "paper-medium": _papers(codebook=600),
    "paper-accurate": _papers(logits=100, codebook=600),
}


def resolve_preset(preset: str | Preset, *, guidance_scale: float | None = None) -> Preset:
    """``preset`` itself, or the one of that name; with ``guidance_scale`` in all steps if one is given.

    Raises:
        TypeError: If it is neither.
        ValueError: If there is none of that name, or the scale is no number.
    """
    plan = _resolved(preset)
    return plan if guidance_scale is None else replace(plan, guidance_scale=guidance_scale, guided_share=1.0)


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


def with_limits(
    plan: Preset,
    *,
    tolerance: str | float | None = None,
    time_budget: str | float | None = None,
    naturalness: float | None = None,
) -> Preset:
    """``plan`` with other limits of latent editing; ``None`` leaves one as it is.

    Args:
        plan: A preset.
        tolerance: Control error at which latents are left, in metres or with a unit: ``"1mm"``, ``"2 cm"``.
        time_budget: Time for the editing of latents, in seconds or with a unit: ``"200ms"``.
        naturalness: Strength of the terms that keep editing natural; 0 leaves them out.

    Raises:
        ValueError: If a quantity is unusable.
    """
    budget = plan.budget
    if naturalness is not None:
        budget = replace(budget, naturalness=_strength(naturalness))
    near = plan.closes_from
    if tolerance is not None:
        metres = quantity("tolerance", tolerance, _LENGTHS)
        budget, near = replace(budget, tolerance=metres), None if near is None else metres
    if time_budget is not None:
        budget = replace(budget, time_budget=quantity("time_budget", time_budget, _TIMES))
    return replace(plan, budget=budget, closes_from=near)


def _strength(value: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < math.inf:
        raise ValueError(
            f"`naturalness` must be a number of at least 0 (0 none, 1 the presets'), got {value!r}."
        )
    return float(value)


def quantity(name: str, value: str | float, units: Mapping[str, float]) -> float:
    """A positive number, given plain or as text with one of the units.

    Raises:
        ValueError: If it is none; the message shows the units.
    """
    number: float | None = None
    if isinstance(value, str):
        match = re.fullmatch(r"\s*([0-9.]+(?:e-?[0-9]+)?)\s*([a-z]+)\s*", value)
        if match is not None and match[2] in units and match[1].count(".") <= 1 and match[1] != ".":
            number = float(match[1]) * units[match[2]]
    elif not isinstance(value, bool) and isinstance(value, int | float):
        number = float(value)
    if number is None or not (math.isfinite(number) and number > 0):
        first, *rest = units
        raise ValueError(
            f"`{name}` must be a positive number of {first} or text such as "
            f"{' or '.join(repr(f'5{unit}') for unit in rest)}, got {value!r}."
        )
    return number
