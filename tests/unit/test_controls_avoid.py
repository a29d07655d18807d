"""Obstacles as users give them: shapes that stand or move, who avoids them, and what is refused."""

from __future__ import annotations

import math

import pytest
import torch

from controlmm.controls import (
    Avoid,
    Box,
    Capsule,
    HalfSpace,
    HeightField,
    Plane,
    Sphere,
    as_avoids,
    yaw_matrix,
)
from controlmm.controls.shape_fields import placed, spread
from controlmm.motion.skeleton import HUMANML3D
from controlmm.ops import obstacle_loss

BALL = Sphere(center=(0.5, 0.9, 1.5), radius=0.4)
SHAPES = [
    BALL,
    Capsule((0, 0, 1), (0, 2, 1), 0.1),
    Box((1, 0.5, 2), (0.5, 0.5, 0.2), yaw_matrix(30)),
    Plane((0, 0, 3), (0, 0, 1)),
    HalfSpace((0, 0, 3), (0, 0, -1)),
    HeightField([[0.0, 0.1], [0.2, 0.3]], (-1, -1), (2, 2)),
]


def test_bare_shapes_become_obstacles_of_all_joints_with_a_margin():
    (plain, given) = as_avoids([BALL, Avoid(BALL, joints=["head", 0], margin=0.2)])
    assert plain.shape is BALL
    assert (plain.margin, plain.joint_radius, plain.joints) == (0.05, 0.0, None)
    assert plain.joint_indices(HUMANML3D) is None
    assert given.joint_indices(HUMANML3D) == (0, 15)


def test_a_still_shape_is_the_same_over_any_number_of_frames():
    assert Avoid(BALL).over(40) is BALL


def test_key_frames_of_a_moving_shape_are_joined_evenly_and_held_outside():
    rolls = Avoid(Sphere(center=[[0, 1, 0], [2, 1, 4]], radius=[0.1, 0.3]), frames=[2, 6])
    shape = rolls.over(9)
    assert shape.center[:, 0].tolist() == [0, 0, 0, 0.5, 1, 1.5, 2, 2, 2]
    assert shape.center[:, 2].tolist() == [0, 0, 0, 1, 2, 3, 4, 4, 4]
    torch.testing.assert_close(shape.radius[[0, 4, 8]], torch.tensor([0.1, 0.2, 0.3]))
    assert rolls.is_moving


def test_a_turning_box_goes_through_the_rotation_half_way():
    turns = torch.stack([yaw_matrix(0), yaw_matrix(60)])
    box = Avoid(Box((0, 1, 0), (1, 1, 0.1), turns), frames=[0, 2]).over(3)
    torch.testing.assert_close(box.rotation[1], yaw_matrix(30))


def test_positive_yaw_turns_to_the_left():
    ahead = torch.tensor([0.0, 0.0, 1.0])
    torch.testing.assert_close(yaw_matrix(90) @ ahead, torch.tensor([1.0, 0.0, 0.0]))


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_moving_a_shape_and_the_joints_together_changes_nothing(shape):
    joints = torch.rand(1, 5, 22, 3, generator=torch.Generator().manual_seed(0)) * 4
    offset = torch.tensor([0.7, 0.0, -1.3])
    before = obstacle_loss(joints, [shape], margin=0.3)
    after = obstacle_loss(joints + offset, [placed(shape, offset=offset)], margin=0.3)
    torch.testing.assert_close(before, after, rtol=1e-4, atol=1e-6)
    assert before > 0


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_a_shape_in_millimetres_gives_a_thousand_times_the_depth(shape):
    joints = torch.rand(1, 5, 21, 3, generator=torch.Generator().manual_seed(1)) * 2
    in_metres = obstacle_loss(joints, [shape])
    scaled = placed(shape, offset=torch.zeros(3), scale=1000.0)
    torch.testing.assert_close(obstacle_loss(1000 * joints, [scaled]), 1000 * in_metres, rtol=1e-4, atol=1e-3)


def test_moving_an_obstacle_keeps_who_avoids_it_and_when():
    before = Avoid(Sphere([[0, 1, 0], [1, 1, 0]], 0.2), joints=["head"], frames=[3, 9], margin=0.1)
    after = before.moved(torch.tensor([1.0, 0.0, 2.0]))
    assert after.shape.center.tolist() == [[1, 1, 2], [2, 1, 2]]
    assert (after.joints, after.margin, after.frames.tolist()) == (("head",), 0.1, [3, 9])


def test_rows_without_frames_stay_after_the_last():
    assert spread(Sphere([[0, 0, 0], [1, 0, 0]], 0.1), None, 4).center[:, 0].tolist() == [0, 1, 1, 1]


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (lambda: Avoid((0, 0, 0)), TypeError, r"`shape` must be a Sphere, Capsule, Box, .* got tuple"),
        (lambda: Avoid(BALL, margin=-0.1), ValueError, r"`margin` must be a finite number of at least 0 m"),
        (lambda: Avoid(BALL, joint_radius=math.nan), ValueError, r"`joint_radius` must be a finite number"),
        (lambda: Avoid(BALL, joints="head"), TypeError, r"`joints` must be a sequence .* Pass \['head'\]"),
        (lambda: Avoid(BALL, joints=[]), ValueError, r"`joints` is empty"),
        (lambda: Avoid(BALL, joints=["haed"]), ValueError, r'Unknown joint "haed"\. Did you mean "head"\?'),
        (lambda: Avoid(BALL, frames=[0, 5]), ValueError, r"`frames` is for moving obstacles, .* sphere"),
        (
            lambda: Avoid(Sphere([[0, 0, 0]] * 3, 1), frames=[0, 5]),
            ValueError,
            r"`center` must have one row for each of the 2 `frames`, got 3 rows",
        ),
        (lambda: Avoid(Sphere([[0, 0, 0]] * 2, 1), frames=[5, 0]), ValueError, r"`frames` must rise"),
        (
            lambda: Avoid(Capsule([[0, 0, 0]] * 2, [[0, 1, 0]] * 3, 0.1)),
            ValueError,
            r"need one number of rows, got `start` 2, `end` 3",
        ),
        (lambda: Avoid(Sphere(torch.zeros(2, 4, 3), 1)), ValueError, r"All samples share their obstacles"),
        (
            lambda: Avoid(Sphere([[0, 0, 0]] * 4, 1)).over(6),
            ValueError,
            r"The sphere moves over 4 frames, but the clip has 6\. Give one row for each frame",
        ),
        (
            lambda: Avoid(Sphere([[0, 0, 0]] * 2, 1), frames=[0, 9]).over(6),
            ValueError,
            r"The sphere names frame 9, but the clip has 6 frames \(0\.\.5\)",
        ),
        (lambda: as_avoids(BALL), TypeError, r"`obstacles` must be a list of obstacles, got Sphere"),
        (
            lambda: as_avoids([BALL, 3]),
            TypeError,
            r"`obstacles\[1\]` must be a shape such as Sphere, or an Avoid",
        ),
    ],
)
def test_mistakes_are_refused(make, kind, message):
    with pytest.raises(kind, match=message):
        make()
