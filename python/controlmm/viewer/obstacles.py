"""Obstacles in pictures: outlines from any direction, pale where a moving one was or will be."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from numpy import ndarray

from controlmm.controls.clearance import clearance
from controlmm.controls.shape_fields import fields_of, moving_fields
from controlmm.ops import Box, Capsule, HeightField, Obstacle, Plane, Sphere
from controlmm.viewer import palette
from controlmm.viewer.hull import convex_hull
from controlmm.viewer.scene import Scene

_GHOSTS = 4  # times at which a moving obstacle is drawn
_RING = 48  # points of a circle
_WALL = (1.5, 2.2)  # metres that a plane is drawn beside its foot point, and the height of a wall

Projection = Callable[[Float[ndarray, "*B 3"]], Float[ndarray, "*B 2"]]


def draw_obstacles(axes: Axes, scene: Scene, project: Projection, *, zorder: float = 1.5) -> None:
    """Draw all obstacles of the scene, a moving one at a few times, later ones stronger.

    Args:
        axes: Axes in metres of the picture.
        scene: What is shown.
        project: World points (..., 3) to points of the picture (..., 2); must be linear.
        zorder: Where they lie among the other artists.
    """
    for shape, opacity in _shapes_in_time(scene):
        draw_shape(axes, shape, project, opacity=opacity, zorder=zorder)


def draw_shape(axes: Axes, shape: Obstacle, project: Projection, *, opacity: float, zorder: float) -> None:
    """Draw one still shape as its outline, filled."""
    points = project(surface_points(shape))
    style: dict[str, Any] = {"color": palette.OBSTACLE, "zorder": zorder}
    if isinstance(shape, HeightField):
        for lines in (points, points.swapaxes(0, 1)):
            axes.plot(lines[..., 0], lines[..., 1], linewidth=0.6, alpha=0.6 * opacity, **style)
        return
    outline = convex_hull(points.reshape(-1, 2))
    axes.add_patch(Polygon(outline, linewidth=0, alpha=0.22 * opacity, **style))
    axes.add_patch(Polygon(outline, fill=False, linewidth=1.3, alpha=opacity, **style))


def obstacle_points(scene: Scene) -> Float[ndarray, "N 3"]:
    """Points around all bounded obstacles, for the limits of a picture."""
    clouds = [
        surface_points(shape).reshape(-1, 3)
        for shape, _ in _shapes_in_time(scene)
        if not isinstance(shape, Plane | HeightField)
    ]
    return np.concatenate(clouds) if clouds else np.zeros((0, 3))


def surface_points(shape: Obstacle) -> Float[ndarray, "*B 3"]:
    """Points whose hull is the shape; of a plane a piece about its point, of a height field its grid."""
    fields = {name: value.detach().double().numpy() for name, value in fields_of(shape).items()}
    points: ndarray
    if isinstance(shape, Sphere):
        points = fields["center"] + fields["radius"] * _ball()
    elif isinstance(shape, Capsule):
        points = np.stack([fields["start"], fields["end"]])[:, None] + fields["radius"] * _ball()
    elif isinstance(shape, Box):
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
        points = fields["center"] + (corners * fields["half_extents"]) @ fields["rotation"].T
    elif isinstance(shape, HeightField):
        rows, columns = np.indices(fields["heights"].shape)
        (x, z), (across, ahead) = fields["origin"], fields["spacing"]
        points = np.stack([x + across * rows, fields["heights"], z + ahead * columns], axis=-1)
    else:
        points = _piece_of_plane(fields["point"], fields["normal"])
    return points


def _piece_of_plane(point: ndarray, normal: ndarray) -> Float[ndarray, "4 3"]:
    """A rectangle: of a wall from the ground up, of a floor or a slope around its point."""
    across = np.cross([0.0, 1.0, 0.0], normal)
    if np.linalg.norm(across) < 1e-6:  # a floor or a ceiling
        across = np.array([1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    up = np.cross(normal, across)
    up *= np.sign(up[1]) if abs(up[1]) > 1e-6 else 1.0
    beside, height = _WALL
    foot = point - (point[1] / up[1] * up if up[1] > 0.5 else beside * up)
    reach = height if up[1] > 0.5 else 2 * beside
    return np.stack(
        [foot + a * beside * across + b * reach * up for a, b in ((-1, 0), (1, 0), (1, 1), (-1, 1))]
    )


def _ball() -> Float[ndarray, "N 3"]:
    """Points on the unit sphere, dense enough that any outline of them is round."""
    polar = np.linspace(0.0, np.pi, _RING // 2 + 1)
    around = np.linspace(0.0, 2 * np.pi, _RING, endpoint=False)
    ring = np.stack([np.cos(around), np.zeros(_RING), np.sin(around)], axis=-1)
    result: ndarray = np.sin(polar)[:, None, None] * ring + np.cos(polar)[:, None, None] * [0.0, 1.0, 0.0]
    return result.reshape(-1, 3)


def _shapes_in_time(scene: Scene) -> Iterator[tuple[Obstacle, float]]:
    for avoid in scene.obstacles:
        if not avoid.is_moving:
            yield avoid.shape, 1.0
            continue
        shape = avoid.over(scene.num_frames)
        frames = np.linspace(0, scene.num_frames - 1, _GHOSTS).round().astype(int)
        for frame, opacity in zip(frames, np.linspace(0.25, 1.0, _GHOSTS), strict=True):
            yield still_at(shape, int(frame)), float(opacity)


def still_at(shape: Obstacle, frame: int) -> Obstacle:
    """A shape that moves over the clip as it is at ``frame``."""
    moving = moving_fields(shape)
    return type(shape)(
        **{name: value[frame] if name in moving else value for name, value in fields_of(shape).items()}
    )


def clearance_over_time(scene: Scene) -> Float[ndarray, "T"] | None:
    """Room in metres between the obstacles and the nearest joint that avoids them; ``None`` without any."""
    if not scene.obstacles:
        return None
    joints = torch.from_numpy(scene.joints)[None]
    rooms = [clearance(joints, avoid, scene.skeleton)[0].amin(-1) for avoid in scene.obstacles]
    nearest: ndarray = torch.stack(rooms).amin(0).numpy()
    return nearest
