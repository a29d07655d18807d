"""Obstacles in pictures: outlines of every shape, and pictures with them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from controlmm.controls import Avoid, Box, Capsule, HalfSpace, HeightField, Plane, Sphere, yaw_matrix
from controlmm.ops import pack_obstacles, signed_distances
from controlmm.viewer.hull import convex_hull
from controlmm.viewer.obstacles import clearance_over_time, still_at, surface_points
from controlmm.viewer.scene import scene_of
from controlmm.viewer.scene_views import save_scene_views

SHAPES = [
    Sphere((0.5, 0.9, 1.5), 0.4),
    Capsule((0, 0, 1), (0, 2, 1), 0.1),
    Box((1, 0.5, 2), (0.5, 0.5, 0.2), yaw_matrix(30)),
    Plane((0, 1, 3), (0.3, 0.1, 1)),
    HalfSpace((0, 0, 0), (0, 1, 0)),
    HeightField([[0.0, 0.1], [0.2, 0.3]], (-1, -1), (2, 2)),
]


def test_the_hull_of_a_square_with_points_inside_is_the_square():
    corners = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], dtype=float)
    inside = np.random.default_rng(0).uniform(0, 2, (50, 2))
    hull = convex_hull(np.concatenate([inside, corners]))
    assert {tuple(point) for point in hull} == {tuple(point) for point in corners}


def test_the_hull_of_points_on_a_line_is_its_two_ends():
    assert convex_hull(np.array([[0.0, 0], [1, 1], [3, 3], [2, 2]])).tolist() == [[0, 0], [3, 3]]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_the_points_of_a_shape_lie_on_its_surface(shape):
    points = torch.from_numpy(surface_points(shape).reshape(1, 1, -1, 3))
    distances = signed_distances(points, pack_obstacles([shape], dtype=torch.float64))
    assert distances.max() < 1e-6
    assert (distances > -1e-6).double().mean() > 0.5  # of a capsule's two balls one half each is inside


def test_pictures_show_still_and_moving_obstacles(controlled_walking, tmp_path):
    moving = Avoid(Sphere([[1, 1, 0], [-1, 1, 2]], 0.3), frames=[0, 50], joints=["head"])
    motion = dataclasses.replace(
        controlled_walking, extra={**controlled_walking.extra, "obstacles": (*map(Avoid, SHAPES), moving)}
    )
    plain = controlled_walking.save(tmp_path / "plain.png", dpi=40).read_bytes()
    assert motion.save(tmp_path / "with.png", dpi=40).read_bytes() != plain
    assert save_scene_views(motion, tmp_path / "views.png", dpi=40).stat().st_size > 5000
    motion.save(tmp_path / "a.gif", size=(160, 160))


def test_clearance_is_that_of_the_nearest_point(walking):
    ball = Avoid(Sphere((3.0, 1.0, 0.0), 0.5), joints=["head", 0])
    scene = scene_of(dataclasses.replace(walking, extra={"obstacles": (ball,)}))
    distance = np.linalg.norm(scene.joints[:, [0, 15]] - [3.0, 1.0, 0.0], axis=-1).min(1) - 0.5
    np.testing.assert_allclose(clearance_over_time(scene), distance, atol=1e-6)
    assert clearance_over_time(scene_of(walking)) is None


def test_a_moving_shape_at_a_frame_is_a_still_one():
    shape = Avoid(Sphere([[0, 1, 0], [2, 1, 0]], 0.3), frames=[0, 4]).over(5)
    assert still_at(shape, 2).center.tolist() == [1, 1, 0]
