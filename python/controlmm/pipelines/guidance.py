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
        share: Of the decoding steps: the first ones, in which the base is guided. In the others it follows
            the text plainly, at half the cost.
    """

    base: float = 4.0
    residual: float = 5.0
    control: float = 1.0
    share: float = 1.0

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise ValueError(f"`{name}` of the guidance must be a finite number, got {value!r}.")
        if not 0 <= self.share <= 1:
            raise ValueError(f"`share` of the guidance must be from 0 to 1, got {self.share!r}.")

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> Self:
        """What :func:`dataclasses.asdict` made, as ``pipeline.json`` holds it.

        Raises:
            ValueError: If a name is unknown or a value is no number, or no share.
        """
        if not isinstance(stored, Mapping):
            raise ValueError(f"`guidance` must hold numbers such as base and residual, got {stored!r}.")
        names = [field.name for field in dataclasses.fields(cls)]
        if unknown := sorted(set(stored) - set(names)):
            raise ValueError(f"`guidance` has {', '.join(names)}; got {', '.join(unknown)}, too.")
        return cls(**stored)

    def under(self, plan: Preset) -> Guidance:
        """The model's, where ``plan`` has none of its own."""
        base, residual, share = plan.guidance_scale, plan.residual_guidance_scale, plan.guided_share
        return replace(
            self,
            base=self.base if base is None else base,
            residual=self.residual if residual is None else residual,
            share=self.share if share is None else share,
        )


PUBLISHED = Guidance()
# For models that `controlmm train` makes: with less than published, FID, jerk, stretched bones and sliding
# feet all fall on validation clips (`python -m benchmarks.text_decoding --only guidance`). Told of thrice
# the missing speed, residual control comes closest before any editing.
# Guided in the first half of the steps alone, motions are as good.
TRAINED_HERE = Guidance(base=2.0, residual=3.0, control=3.0, share=0.5)
