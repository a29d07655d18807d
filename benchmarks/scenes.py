"""Random scenes with obstacles and a goal, the same for the same number."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from controlmm.controls import Avoid, Box, Capsule, JointControl, Sphere, yaw_matrix

FRAMES = 120
MOST_OBSTACLES = 6
_CLEAR = 0.75  # metres around start and goal that obstacles leave free
_BESIDE = 0.5  # metres to either side of the straight way within which they stand


@dataclass(frozen=True)
class ObstacleScene:
    """A walk from the origin to a goal with obstacles on the straight way there."""

    prompt: str
    goal: JointControl
    obstacles: tuple[Avoid, ...]

    @property
    def num_moving(self) -> int:
        """Obstacles that move."""
        return sum(obstacle.is_moving for obstacle in self.obstacles)


def random_scene(number: int) -> ObstacleScene:
    """Scene ``number``: 1 to 6 obstacles (number modulo 6, plus 1), of which about a third move."""
    rng = np.random.default_rng(1000 + number)
    distance, direction = rng.uniform(3.0, 5.0), math.radians(rng.uniform(-30, 30))
    ahead = np.array([math.sin(direction), 0.0, math.cos(direction)])
    goal = distance * ahead
    control = JointControl("pelvis", frames=[FRAMES - 1], positions=[[goal[0], None, goal[2]]])
    obstacles = tuple(_obstacle(rng, distance, ahead) for _ in range(number % MOST_OBSTACLES + 1))
    return ObstacleScene("a person walks forward", control, obstacles)


def _obstacle(rng: np.random.Generator, distance: float, ahead: np.ndarray) -> Avoid:
    """Something on the straight way: a ball, a pillar, a crate, or a ball that rolls across."""
    left = np.array([ahead[2], 0.0, -ahead[0]])
    kind = rng.choice(["ball", "pillar", "crate", "rolling"], p=[0.25, 0.25, 0.2, 0.3])
    size = rng.uniform(0.15, 0.4)
    along = rng.uniform(_CLEAR + size, distance - _CLEAR - size)
    foot = along * ahead + rng.uniform(-_BESIDE, _BESIDE) * left
    if kind == "ball":
        return Avoid(Sphere(foot + np.array([0, rng.uniform(0.6, 1.2), 0]), size))
    if kind == "pillar":
        return Avoid(Capsule(foot, foot + np.array([0, 2.0, 0]), 0.6 * size))
    if kind == "crate":
        extents = rng.uniform(0.15, 0.35, 3)
        return Avoid(Box(foot + np.array([0, extents[1], 0]), extents, yaw_matrix(rng.uniform(0, 90))))
    side, height = rng.choice([-2.0, 2.0]), np.array([0.0, rng.uniform(0.6, 1.2), 0.0])
    when = int(FRAMES * along / distance)  # it crosses when a steady walker would be there
    span = rng.integers(15, 30)
    return Avoid(
        Sphere(np.stack([foot + height + side * left, foot + height - side * left]), size),
        frames=[max(0, when - span), min(FRAMES - 1, when + span)],
    )
