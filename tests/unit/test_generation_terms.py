"""Terms of editing: obstacles and objectives, their frame, their padding, their share of the gradient."""

from __future__ import annotations

import pytest
import torch

from controlmm.controls import Avoid, Capsule, HalfSpace, Objective, Sphere
from controlmm.generation.objective import ControlObjective
from controlmm.generation.terms import HeldTerm, ObjectiveTerm, OnFloor, obstacle_terms
from controlmm.motion.skeleton import HUMANML3D, KIT

ORIGIN = torch.tensor([1.0, 0.0, -2.0])
JOINTS = torch.rand(2, 8, 22, 3, generator=torch.Generator().manual_seed(0))
LENGTHS = torch.tensor([8, 6])


def terms_of(obstacles, **options):
    arguments = {
        "lengths": LENGTHS,
        "frames": 8,
        "skeleton": HUMANML3D,
        "origin": ORIGIN,
        "padded": 8,
        "weight": 1.0,
    }
    return obstacle_terms(obstacles, **{**arguments, **options})


def test_depth_is_summed_over_joints_frames_and_obstacles_in_the_callers_world():
    """By hand: a head at 0.1 m from the centre of a ball of 0.3 m, margin 0.05, is 0.25 m too near."""
    joints = torch.full((2, 8, 22, 3), 9.0)
    joints[0, 3, 15] = torch.tensor([0.0, 1.6, 1.0])
    ball = Avoid(Sphere(center=(1.1, 1.6, -1.0), radius=0.3), joints=["head"], margin=0.05)
    (term,) = terms_of([ball])
    torch.testing.assert_close(term.values(joints), torch.tensor([0.25, 0.0]))
    (many,) = terms_of([ball, ball], weight=3.0)
    torch.testing.assert_close(many.values(joints), torch.tensor([1.5, 0.0]))


def test_obstacles_that_the_same_joints_avoid_by_the_same_distance_share_a_term():
    ball = Sphere((0, 0, 0), 1)
    obstacles = [Avoid(ball), Avoid(ball, margin=0.02, joint_radius=0.03), Avoid(ball, joints=["head"])]
    assert [len(term.obstacles) for term in terms_of(obstacles)] == [2, 1]


def test_frames_after_a_clips_end_do_not_count():
    (term,) = terms_of([Avoid(Sphere((1, 0.5, -2), 1.0))])
    changed = JOINTS.clone()
    changed[1, 6:] = 0.5
    assert torch.equal(term.values(JOINTS), term.values(changed))
    assert torch.equal(term.select(torch.tensor([1])).values(JOINTS[1:]), term.values(JOINTS)[1:])


def test_a_moving_obstacle_stands_still_in_padding():
    moving = Avoid(Sphere([[0, 0, i] for i in range(8)], 0.1))
    (term,) = terms_of([moving], padded=12)
    assert term.obstacles.parameters[0, 0, 2].tolist() == [2 + min(i, 7) for i in range(12)]


def test_kit_obstacles_are_turned_into_millimetres():
    (term,) = terms_of([Avoid(Sphere((0, 1, 0), 0.5), margin=0.0)], skeleton=KIT, origin=torch.zeros(3))
    joints = torch.full((2, 8, 21, 3), 9e3)
    joints[0, 0, 20] = torch.tensor([0.0, 900.0, 0.0])  # a joint without children
    torch.testing.assert_close(term.values(joints), torch.tensor([400.0, 0.0]))


def test_held_poses_are_the_mean_squared_error_of_their_coordinates():
    targets = JOINTS.clone()
    targets[0, 2, 5] += 0.3
    mask = torch.zeros(JOINTS.shape, dtype=torch.bool)
    mask[:, 2, 4:6] = True
    term = HeldTerm(targets, mask)
    torch.testing.assert_close(term.values(JOINTS), torch.tensor([0.045, 0.0]))  # half of 0.09
    assert term.select(torch.tensor([1])).values(JOINTS[1:]).item() == 0


def test_an_objective_sees_exactly_its_clips_frames_in_the_callers_world():
    seen = []

    def mean_height(joints):
        seen.append(joints)
        return joints[..., 1].mean((1, 2))

    term = ObjectiveTerm(Objective(mean_height, weight=2.0), True, LENGTHS, ORIGIN)
    values = term.values(JOINTS)
    expected = torch.stack([2 * JOINTS[0, ..., 1].mean(), 2 * JOINTS[1, :6, :, 1].mean()])
    torch.testing.assert_close(values, expected)
    assert {clip.shape[1] for clip in seen} == {6, 8}
    torch.testing.assert_close(seen[1], JOINTS[:1] + ORIGIN)
    assert torch.equal(term.select(torch.tensor([1])).values(JOINTS[1:]), values[1:])


def test_terms_of_motions_that_will_be_grounded_see_them_on_the_floor():
    floor = Avoid(HalfSpace((0, 0, 0), (0, 1, 0)), margin=0.0)
    (term,) = terms_of([floor])
    sunk = JOINTS - torch.tensor([0.0, 5.0, 0.0])
    grounded = OnFloor(term, LENGTHS)
    assert term.values(sunk).min() > 100
    torch.testing.assert_close(grounded.values(sunk), torch.zeros(2))
    lifted = grounded.select(torch.tensor([1])).values(JOINTS[1:] + torch.tensor([0.0, 3.0, 0.0]))
    assert lifted.item() == 0


@pytest.mark.parametrize("has_targets", [False, True])
def test_the_gradient_of_an_objective_with_terms_is_that_of_its_value(tiny_pipeline, has_targets):
    """Against central differences along a random direction, in float32."""
    generator = torch.Generator().manual_seed(1)
    decoder = tiny_pipeline.decoder
    latents = torch.randn(2, 4, decoder.tokenizer.config.code_dim, generator=generator)
    frames = torch.ones(2, 16, dtype=torch.bool)
    mask = torch.zeros(2, 16, 22, 3, dtype=torch.bool)
    mask[:, 9, 21] = has_targets
    lengths = torch.tensor([16, 16])
    terms = [
        *terms_of([Avoid(Sphere((1, 0.9, -2), 2.0))], lengths=lengths, frames=16, padded=16),
        ObjectiveTerm(Objective(lambda j: j[:, -1].square().sum((1, 2))), True, lengths, ORIGIN),
    ]
    objective = ControlObjective(decoder, torch.zeros(2, 16, 22, 3), mask, frames, terms=terms)
    loss, gradient = objective.value_and_gradient(latents)
    direction = torch.randn(latents.shape, generator=generator)
    step = 1e-3
    ahead, _ = objective.value_and_gradient(latents + step * direction)
    behind, _ = objective.value_and_gradient(latents - step * direction)
    slope = (gradient * direction).sum((1, 2))
    torch.testing.assert_close((ahead - behind) / (2 * step), slope, rtol=2e-2, atol=0.05)
    alone, own_gradient = objective.select(torch.tensor([1])).value_and_gradient(latents[1:])
    torch.testing.assert_close(alone, loss[1:], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(own_gradient, gradient[1:], rtol=1e-3, atol=1e-4)


def test_a_rod_between_two_joints_touches_the_body_but_not_the_joints():
    joints = torch.full((2, 8, 22, 3), 9.0)
    joints[0, 0, 5], joints[0, 0, 8] = torch.tensor([1.0, 0.5, -2.0]), torch.tensor([1.0, 0.1, -2.0])
    rod = Capsule((-1, 0.3, -2), (3, 0.3, -2), 0.02)
    (body,) = terms_of([Avoid(rod, margin=0.0)], origin=torch.zeros(3))
    (only_joints,) = terms_of([Avoid(rod, joints=range(22), margin=0.0)], origin=torch.zeros(3))
    torch.testing.assert_close(body.values(joints), torch.tensor([0.02, 0.0]))
    assert not only_joints.values(joints).any()
