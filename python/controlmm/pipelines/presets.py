"""Named trade-offs between time and control error."""

from __future__ import annotations

from dataclasses import dataclass

from controlmm.generation.editing import EditingBudget


@dataclass(frozen=True)
class Preset:
    """How a motion is decoded and edited."""

    budget: EditingBudget
    steps: int = 10  # of masked decoding
    guidance_scale: float = 4.0
    residual_guidance_scale: float = 5.0


# The iteration counts are the papers' Fast, Medium and Accurate.
PRESETS = {
    "fast": Preset(EditingBudget(logits_iterations=0, latent_iterations=100)),
    "balanced": Preset(EditingBudget(logits_iterations=0, latent_iterations=600)),
    "accurate": Preset(EditingBudget(logits_iterations=100, latent_iterations=600)),
}


def preset_named(name: str) -> Preset:
    """The preset called ``name``.

    Raises:
        ValueError: If there is none; the message lists them.
    """
    if name not in PRESETS:
        raise ValueError(f"Unknown `preset` {name!r}. Use one of: {', '.join(PRESETS)}.")
    return PRESETS[name]
