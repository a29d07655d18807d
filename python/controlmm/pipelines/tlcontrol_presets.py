"""Named trade-offs between time and control error for TLControl."""

from __future__ import annotations

from dataclasses import dataclass, replace

from controlmm.generation.code_optimization import CodeOptimization, is_number
from controlmm.motion.body_parts import part_index


@dataclass(frozen=True)
class TLControlPreset(CodeOptimization):
    """How codes are drawn, beside how they are optimised (:class:`CodeOptimization`).

    Attributes:
        temperature: Of the codes; 0 takes the most likely ones, as the paper does, and then all samples are
            alike.
        guidance_scale: How strongly the text counts; 1 is the paper's. Above it, predicted codes may not fit
            unusual paths any more, and the optimisation starts too far away.
        rounds: Passes of the network before the last one, each with the six trajectories of the motion that
            the one before drew: feet then agree with the way. The paper has none.
        vary: Only this body part differs between samples; ``None``: all do.
    """

    temperature: float = 0.5
    guidance_scale: float = 1.0
    rounds: int = 3
    vary: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not is_number(self.temperature) or self.temperature < 0:
            raise ValueError(f"`temperature` must be a number of at least 0, got {self.temperature!r}.")
        if not is_number(self.guidance_scale):
            raise ValueError(f"`guidance_scale` must be a finite number, got {self.guidance_scale!r}.")
        if isinstance(self.rounds, bool) or not isinstance(self.rounds, int) or self.rounds < 0:
            raise ValueError(f"`rounds` must be a whole number of at least 0, got {self.rounds!r}.")
        if self.vary is not None:
            part_index(self.vary)


TLCONTROL_PRESETS = {
    "fast": TLControlPreset(tolerance=1e-5),
    "balanced": TLControlPreset(),
    "accurate": TLControlPreset(tolerance=1e-8),
    "paper": TLControlPreset(
        temperature=0.0, guidance_scale=1.0, rounds=0, rate=0.1, loss="smooth_l1", foot="published"
    ),
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
