"""An orthographic camera: world points in metres to points of the picture in metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray


@dataclass(frozen=True)
class Camera:
    """Direction of view. At azimuth 0 the camera stands in front of a figure that faces +Z."""

    azimuth: float = (
        -50.0
    )  # degrees about Y; negative: the camera stands to the figure's right, so +Z runs right
    elevation: float = 16.0  # degrees above the horizon

    def _axes(self) -> Float[ndarray, "3 3"]:
        azimuth, elevation = np.radians([self.azimuth, self.elevation])
        towards = np.array(
            [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
        )
        right = np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])
        return np.stack([right, np.cross(towards, right), towards])

    def project(self, points: Float[ndarray, "*B 3"]) -> Float[ndarray, "*B 2"]:
        """Picture coordinates (right, up) in metres; the world's origin falls on (0, 0)."""
        result: ndarray = points @ self._axes()[:2].T
        return result

    def depth(self, points: Float[ndarray, "*B 3"]) -> Float[ndarray, "*B"]:
        """Distance towards the camera in metres: larger is nearer."""
        result: ndarray = points @ self._axes()[2]
        return result
