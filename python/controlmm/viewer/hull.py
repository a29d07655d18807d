"""Convex outlines of points in the plane."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray


def convex_hull(points: Float[ndarray, "N 2"]) -> Float[ndarray, "M 2"]:
    """Corners of the convex hull, anticlockwise; the two ends where all points lie on one line.

    Source: Andrew's monotone chain.
    """
    ordered = np.unique(points.round(6), axis=0)
    lower, upper = _chain(ordered), _chain(ordered[::-1])
    return np.array(lower[:-1] + upper[:-1]) if len(ordered) > 1 else ordered


def _chain(ordered: Float[ndarray, "N 2"]) -> list[ndarray]:
    chain: list[ndarray] = []
    for point in ordered:
        while len(chain) > 1 and _turn(chain[-2], chain[-1], point) <= 0:
            chain.pop()
        chain.append(point)
    return chain


def _turn(a: ndarray, b: ndarray, c: ndarray) -> float:
    """Above 0 where the way a, b, c turns to the left."""
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
