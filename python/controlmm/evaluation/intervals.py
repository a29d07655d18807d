"""A mean over repeats with its 95 % interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

_WIDTH = 1.96  # standard normal, two-sided 95 %


@dataclass(frozen=True)
class Interval:
    """``mean`` and half the width of its 95 % interval; 0 for one repeat, which says nothing of spread."""

    mean: float
    half_width: float

    def __str__(self) -> str:
        return self.shown()

    def shown(self, digits: int = 3) -> str:
        """``0.123`` or, with more than one repeat, ``0.123 ± 0.004``."""
        text = f"{self.mean:.{digits}f}"
        return f"{text} ± {self.half_width:.{digits}f}" if self.half_width else text


def interval(values: Sequence[float]) -> Interval:
    """``1.96 std / sqrt(n)`` about the mean, with the population's standard deviation as in the papers.

    Repeats that are NaN (nothing was controlled) are left out; NaN when all are.

    Raises:
        ValueError: If there is no value.
    """
    if not values:
        raise ValueError("`values` must hold one number for each repeat, got none.")
    known = [value for value in values if not math.isnan(value)]
    if not known:
        return Interval(math.nan, 0.0)
    mean = math.fsum(known) / len(known)
    spread = math.sqrt(math.fsum((value - mean) ** 2 for value in known) / len(known))
    return Interval(mean, _WIDTH * spread / math.sqrt(len(known)))
