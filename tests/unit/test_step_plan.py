"""Where feet should stand: against walks whose steps are known, and paths of known curvature."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from controlmm.generation.step_plan import alternate_stances, slides, step_targets
from controlmm.motion.skeleton import HUMANML3D

FPS, FRAMES, SPEED = 20.0, 80, 1.2
STEP = 12  # frames for which a foot of the known walk stands
ROUNDING = 1e-5  # of float32 places, metres


def walking_feet() -> np.ndarray:
    """(T, 2, 2): feet that stand in turns of 12 frames, left first, and hurry on between, along z."""
    stride = 2 * STEP * SPEED / FPS
    feet = np.zeros((FRAMES, 2, 2))
    for foot in (0, 1):
        turn, within = np.divmod(np.arange(FRAMES) + foot * STEP, 2 * STEP)
        moved = turn + np.clip((within - STEP) / STEP, 0, 1)
        feet[:, foot] = np.stack([np.full(FRAMES, 0.1 - 0.2 * foot), stride * (moved - 0.5 * foot)], axis=1)
    return feet


def straight(speed: float = SPEED) -> np.ndarray:
    return np.stack([np.zeros(FRAMES), np.arange(FRAMES) * speed / FPS], axis=1)


def body(path: np.ndarray, *, yaw: float = 0.0) -> torch.Tensor:
    """(T, 22, 3): a rest pose that glides along a path and faces one way all the time."""
    rest = HUMANML3D.rest_offsets().double()
    places = torch.zeros(22, 3, dtype=torch.float64)
    for joint, parent in enumerate(HUMANML3D.parents):
        if parent >= 0:
            places[joint] = places[parent] + 0.25 * rest[joint]
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, z = places[:, 0].clone(), places[:, 2].clone()
    places[:, 0], places[:, 2] = cos * x + sin * z, cos * z - sin * x
    joints = places.expand(len(path), -1, -1).clone()
    joints[:, :, [0, 2]] += torch.from_numpy(path)[:, None]
    return joints.float()


def led(path: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    targets, mask = torch.zeros(len(path), 22, 3), torch.zeros(len(path), 22, 3, dtype=torch.bool)
    targets[:, 0, [0, 2]], mask[:, 0, 0], mask[:, 0, 2] = torch.from_numpy(path).float(), True, True
    return targets, mask


def circle(radius: float = 1.5) -> np.ndarray:
    angle = np.arange(FRAMES) * SPEED / FPS / radius
    return radius * np.stack([1 - np.cos(angle), np.sin(angle)], axis=1)


def test_feet_that_step_keep_their_steps():
    stances = alternate_stances(walking_feet(), straight(), FPS)
    assert [stance.foot for stance in stances] == [0, 1, 0, 1, 0, 1, 0]
    assert [stance.first for stance in stances] == list(range(0, FRAMES, STEP))


def test_a_body_that_glides_gets_steps_of_usual_length():
    feet = straight()[:, None] + np.array([[0.1, 0.0], [-0.1, 0.0]])
    stances = alternate_stances(feet, straight(), FPS)
    assert [stance.first for stance in stances[1:]] == [stance.last for stance in stances[:-1]]
    assert (stances[0].first, stances[-1].last) == (0, FRAMES - 1)
    assert all(a.foot != b.foot for a, b in pairwise(stances))
    usual = np.sqrt(0.38 * SPEED)  # see `_STEP_RATIO`
    for stance in stances[1:-1]:
        assert 0.8 * usual < (stance.last - stance.first) * SPEED / FPS < 1.2 * usual


@pytest.mark.parametrize(("speed", "expected"), [(0.0, False), (0.6, True), (1.2, True), (3.0, False)])
def test_gliding_at_the_speed_of_a_walk_is_sliding(speed, expected):
    """A body that stands has no steps, and one that runs has other ones."""
    assert slides(body(straight(speed)), *led(straight(speed)), HUMANML3D) is expected


def test_feet_that_stand_do_not_slide():
    joints = body(straight())
    for foot, ball in enumerate((10, 11)):
        joints[:, ball, [0, 2]] = torch.from_numpy(walking_feet()[:, foot]).float()
    assert not slides(joints, *led(straight()), HUMANML3D)


def test_a_standing_start_will_slide_along_its_targets():
    """What counts is the motion as it will be, also between two targets."""
    targets, mask = led(straight())
    mask[1:-1] = False
    assert slides(body(straight(0.0)), targets, mask, HUMANML3D)


@pytest.mark.parametrize("joint", [2, 5, 10])
def test_a_leg_that_has_targets_needs_no_plan(joint):
    targets, mask = led(straight())
    mask[40, joint, 1] = True
    assert not slides(body(straight()), targets, mask, HUMANML3D)


def test_a_foot_stands_in_one_place_and_targets_stay():
    targets, mask = led(circle())
    planned, where = step_targets(body(circle()), targets, mask, HUMANML3D)
    torch.testing.assert_close(planned[mask], targets[mask], rtol=0, atol=0)
    assert not where[..., 1].any(), "heights are free"
    assert set(where.any(-1).any(0).nonzero()[:, 0].tolist()) == {0, 1, 2, 10, 11}
    assert where[:, [10, 11], 0].any(1).all(), "one foot stands at any time"
    for ball in (10, 11):
        stands = where[:, ball, 0]
        steps = planned[:, ball, [0, 2]].diff(dim=0).norm(dim=-1)[stands[1:] & stands[:-1]]
        assert (steps > ROUNDING).sum() <= 1, "turns of a foot do not touch, but at the ends of a clip"


def test_hips_face_along_the_path():
    planned, where = step_targets(body(circle()), *led(circle()), HUMANML3D)
    across = (planned[:, 1] - planned[:, 2])[:, [0, 2]].numpy()
    angle = np.arange(FRAMES) * SPEED / FPS / 1.5
    left = np.stack([np.cos(angle), -np.sin(angle)], axis=1)  # of a body that walks a circle to the left
    inner = slice(8, -8)  # directions are averaged over 8 frames
    cosine = (across * left).sum(1) / np.linalg.norm(across, axis=1)
    assert where[:, [1, 2], 0].all()
    assert (cosine[inner] > 0.999).all()


@pytest.mark.parametrize("yaw", [np.pi, np.pi / 2])
def test_who_walks_backwards_or_sideways_may_go_on(yaw):
    _, where = step_targets(body(straight(), yaw=yaw), *led(straight()), HUMANML3D)
    assert where[:, [10, 11]].any()
    assert not where[:, [1, 2]].any()


def test_other_joints_with_targets_say_where_the_body_faces():
    targets, mask = led(circle())
    mask[40, 20] = True
    _, where = step_targets(body(circle()), targets, mask, HUMANML3D)
    assert where[:, [10, 11]].any()
    assert not where[:, [1, 2]].any()


def test_who_stops_stands_as_he_likes():
    path = straight()
    path[40:] = path[40]
    _, where = step_targets(body(path), *led(path), HUMANML3D)
    assert where[:40, [10, 11]].any()
    assert not where[62:, [10, 11]].any()
