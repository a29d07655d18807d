"""How strongly text and targets count: a property of a model, found on validation clips."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

from controlmm.pipelines.presets import Preset


@dataclass(frozen=True)
class Guidance:
    """Scales of classifier-free guidance, by default the published ones, and of residual control.

    Attributes:
        base: Of the masked transformer, which predicts the base layer.
        residual: Of the residual transformer.
        control: Factor of what residual control is told of the speed that is missing.
    """

    base: float = 4.0
    residual: float = 5.0
    control: float = 1.0

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise ValueError(f"`{name}` of the guidance must be a finite number, got {value!r}.")

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> Self:
        """What :func:`dataclasses.asdict` made, as ``pipeline.json`` holds it.

        Raises:
            ValueError: If a name is unknown or a scale is no number.
        """
        if not isinstance(stored, Mapping):
            raise ValueError(f"`guidance` must hold the scales base, residual and control, got {stored!r}.")
        names = [field.name for field in dataclasses.fields(cls)]
        if unknown := sorted(set(stored) - set(names)):
            raise ValueError(f"`guidance` has the scales {', '.join(names)}; got {', '.join(unknown)}, too.")
        return cls(**stored)

    def under(self, plan: Preset) -> Guidance:
        """The model's scales, where ``plan`` has none of its own."""
        base, residual = plan.guidance_scale, plan.residual_guidance_scale
        return replace(
            self,
            base=self.base if base is None else base,
            residual=self.residual if residual is None else residual,
        )


PUBLISHED = Guidance()
# For models that `controlmm train` makes: with less than published, FID, jerk, stretched bones and sliding
# feet all fall on validation clips (`python -m benchmarks.text_decoding --only guidance`). Told of thrice
# the missing speed, residual control comes closest before any editing.
TRAINED_HERE = Guidance(base=2.0, residual=3.0, control=3.0)
