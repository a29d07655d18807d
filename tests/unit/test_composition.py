"""Parts of several motions on one body: who moves what, where seams are, and the relative loss."""

from __future__ import annotations

import pytest
import torch

from controlmm.controls import TimelineEntry, yaw_matrix
from controlmm.generation.composition import TRANSITION, Tracks, composed, local_positions
from controlmm.generation.relative_term import RelativeTerm
from controlmm.motion.features import canonicalize, joints_to_features
from controlmm.motion.skeleton import HUMANML3D
from controlmm.ops import recover_joints

ROUNDED = 1e-4  # metres: float32, steps of 60 frames summed up


def entry(part, start, end):
    return TimelineEntry(part, "a person does something", frames=(start, end))


def column(tracks, part):
    """Owners of root, trunk, left_arm, right_arm, left_leg or right_leg as runs: (entry, frames)."""
    names = ["root", "trunk", "left_arm", "right_arm", "left_leg", "right_leg"]
    owners, counts = torch.unique_consecutive(tracks.owners[:, names.index(part)], return_counts=True)
    return list(zip(owners.tolist(), counts.tolist(), strict=True))


def test_a_part_follows_the_first_entry_that_names_it_and_else_the_legs():
    tracks = Tracks.of([entry("right_arm", 10, 30), entry("upper", 20, 50), entry("lower", 0, 60)], HUMANML3D)
    assert column(tracks, "right_arm") == [(2, 10), (0, 20), (1, 20), (2, 10)]
    assert column(tracks, "left_arm") == [(2, 20), (1, 30), (2, 10)]
    assert column(tracks, "trunk") == [(2, 20), (1, 30), (2, 10)]
    assert column(tracks, "root") == column(tracks, "left_leg") == [(2, 60)]


def test_without_legs_the_first_entry_carries_and_gaps_go_on_as_before():
    tracks = Tracks.of([entry("left_arm", 10, 20), entry("right_arm", 30, 40)], HUMANML3D)
    assert column(tracks, "root") == [(0, 30), (1, 10)]
    assert tracks.span(0) == (0, 30 + TRANSITION)
    assert tracks.span(1) == (30 - TRANSITION, 40)


def test_frames_beside_a_change_are_not_known():
    tracks = Tracks.of([entry("lower", 0, 60), entry("left_wrist", 20, 40)], HUMANML3D)
    known = tracks.known_joints
    unknown = [f for f in range(60) if not known[f, 20]]
    assert unknown == [*range(15, 25), *range(35, 45)]
    assert known[:, 21].all()
    assert tracks.joints_of(1)[25].nonzero()[:, 0].tolist() == [13, 16, 18, 20]


@pytest.fixture
def two(walk):
    """Features of two walks of different speed and bend."""
    return [joints_to_features(canonicalize(walk(61, turn=turn).float())) for turn in (0.4, -0.9)]


def test_one_entry_is_its_own_motion(two):
    tracks = Tracks.of([entry("body", 0, 60)], HUMANML3D)
    made = composed(tracks, [two[0]], [0])
    torch.testing.assert_close(
        recover_joints(made[None], joints=22), recover_joints(two[0][None], joints=22), rtol=0, atol=ROUNDED
    )


def test_an_arm_hangs_on_the_chest_of_the_carrier_and_moves_as_in_its_own_motion(two):
    tracks = Tracks.of([entry("lower", 0, 60), entry("left_arm", 20, 40)], HUMANML3D)
    made = local_positions(composed(tracks, [two[0], two[1][:30]], [0, 15]), HUMANML3D)
    first, second = (local_positions(motion, HUMANML3D) for motion in two)
    rest = [j for j in range(22) if j not in (13, 16, 18, 20)]
    torch.testing.assert_close(made[:, rest], first[:, rest])
    arm, own = made[:, [13, 16, 18, 20]] - made[:, 9:10], second[:, [13, 16, 18, 20]] - second[:, 9:10]
    torch.testing.assert_close(arm[25:35], own[10:20], rtol=0, atol=ROUNDED)
    assert made[14:26, 20].diff(n=2, dim=0).abs().max() < ROUNDED  # an even way across the seam


def test_the_relative_loss_ignores_where_the_body_stands_and_faces(walk):
    joints = walk(40, turn=0.5).float()[None]
    known = torch.ones(40, 22, dtype=torch.bool)
    term = RelativeTerm.towards(joints, known, padded=44, skeleton=HUMANML3D)
    elsewhere = joints @ yaw_matrix(70).T + torch.tensor([3.0, 0.0, -2.0])
    padded = torch.cat([elsewhere, torch.randn(1, 4, 22, 3)], dim=1)
    assert term.values(padded).item() < ROUNDED**2
    assert term.errors(elsewhere).item() < ROUNDED


def test_the_relative_loss_of_a_raised_hand_and_of_a_slower_walk(walk):
    """By hand: one joint 0.3 m too high in one of 40 x 22 poses; steps that are half as long."""
    joints = walk(40).float()[None]
    term = RelativeTerm.towards(joints, torch.ones(40, 22, dtype=torch.bool), padded=40, skeleton=HUMANML3D)
    raised = joints.clone()
    raised[0, 7, 20, 1] += 0.3
    assert term.values(raised).item() == pytest.approx(0.3**2 / 3 / (40 * 22), rel=1e-3)
    assert term.errors(raised).item() == pytest.approx(0.3 / (40 * 22), rel=1e-3)
    way = joints[:, :, :1] * torch.tensor([1.0, 0.0, 1.0])
    slower = joints - 0.5 * way
    step = way[0, :, 0].diff(dim=0)
    assert term.values(slower).item() == pytest.approx((0.5 * step).square().sum(-1).mean().item(), rel=1e-2)
    (gradient,) = torch.autograd.grad(term.values(raised.requires_grad_()).sum(), raised)
    assert torch.isfinite(gradient).all()
    assert gradient.abs().argmax() == ((7 * 22) + 20) * 3 + 1
