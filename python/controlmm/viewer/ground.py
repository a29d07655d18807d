"""The grid on the ground, as a camera sees it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from numpy import ndarray

from controlmm.viewer import palette
from controlmm.viewer.camera import Camera


def ground_box(points: Float[ndarray, "*B 3"], *, margin: float) -> tuple[float, float, float, float]:
    """Box (x0, x1, z0, z1) on the ground around ``points`` (metres), on half metres."""
    flat = points.reshape(-1, 3)[:, [0, 2]]
    low = np.floor(2 * (flat.min(0) - margin)) / 2
    high = np.ceil(2 * (flat.max(0) + margin)) / 2
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def draw_grid(
    axes: Axes, camera: Camera, box: tuple[float, float, float, float], *, step: float = 0.5
) -> None:
    """Draw lines every ``step`` metres over ``box`` at y = 0; whole metres are stronger."""
    x0, x1, z0, z1 = box
    xs, zs = np.arange(x0, x1 + step / 2, step), np.arange(z0, z1 + step / 2, step)
    along_z = [[(x, 0, z0), (x, 0, z1)] for x in xs]
    along_x = [[(x0, 0, z), (x1, 0, z)] for z in zs]
    lines = camera.project(np.array(along_z + along_x, dtype=np.float64))
    is_metre = np.isclose(np.concatenate([xs, zs]) % 1.0, 0)
    widths = np.where(is_metre, 1.0, 0.5)
    grid = LineCollection(list(lines), colors=palette.GRID, linewidths=widths, zorder=0, clip_on=False)
    axes.add_collection(grid, autolim=False)
