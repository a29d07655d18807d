"""Joints of the closed end: the projection against a dense system, bone lengths, planted feet."""

import pytest
import torch

from controlmm.generation.exact.bones import restore_bones
from controlmm.generation.exact.projection import project_on_targets
from controlmm.motion.features import bone_lengths
from controlmm.motion.skeleton import HUMANML3D
from controlmm.ops import frame_bones, project_change, smooth_bones
from controlmm.ops.exact_reference import graph_laplacian, solve_chain
from controlmm.ops.pose_weights import SMOOTHNESS, STANDING, STIFFNESS

TENTH_OF_A_MILLIMETRE = 1e-4
LENGTHS = HUMANML3D.rest_offsets().norm(dim=-1)
PARENTS, FEET = HUMANML3D.parents, HUMANML3D.foot_joints
TOES = (HUMANML3D.left_foot[1], HUMANML3D.right_foot[1])
both_backends = pytest.mark.parametrize("backend", ["auto", "reference"])


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def nowhere(frames: int) -> torch.Tensor:
    return torch.zeros(frames, 22, dtype=torch.bool)


def bone_error(joints: torch.Tensor) -> float:
    return float((bone_lengths(joints, HUMANML3D) - LENGTHS)[:, 1:].abs().max())


def size_of_changes(frames: int) -> torch.Tensor:
    """``R`` of one axis, dense."""
    second = torch.eye(frames).double().diff(n=2, dim=0)
    size = torch.kron(torch.eye(frames), STIFFNESS * graph_laplacian(PARENTS) + torch.eye(22))
    return size + SMOOTHNESS * torch.kron(second.T @ second, torch.eye(22))


def smallest(size: torch.Tensor, held: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """min x^T R x subject to x = values where held, (T, J) both, by its Karush-Kuhn-Tucker matrix."""
    rows = torch.eye(held.numel()).double()[held.flatten()]
    kkt = torch.cat([torch.cat([size, rows.T], 1), torch.cat([rows, torch.zeros(len(rows), len(rows))], 1)])
    right = torch.cat([torch.zeros(held.numel()), values[held]]).double()
    return torch.linalg.solve(kkt, right)[: held.numel()].reshape(held.shape)


@both_backends
@pytest.mark.parametrize("is_planted", [False, True])
def test_the_projection_is_the_solution_of_the_dense_system(is_planted, backend):
    """Steps of planted joints are soft terms of it, also where a target pulls at them."""
    held, change, planted = nowhere(6)[..., None].repeat(1, 1, 3), random(6, 22, 3), nowhere(6)
    held[1, 0], held[4, 20, :2], held[[2, 3], 10, 1], held[4, 3] = True, True, True, True
    size = size_of_changes(6)
    if is_planted:
        planted[2:, 10], planted[0, 7] = True, True  # that of the last frame has no frame to stand in
        for frame, joint in planted[:-1].nonzero().tolist():
            step = torch.zeros(6 * 22, dtype=torch.float64)
            step[[22 * frame + joint, 22 * (frame + 1) + joint]] = torch.tensor([-1, 1.0]).double()
            size = size + STANDING * step[:, None] * step
    expected = torch.stack([smallest(size, held[..., k], change[..., k]) for k in range(3)], dim=-1)
    actual = project_change(change, held, planted, parents=PARENTS, backend=backend)
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-9)


def test_targets_are_met_and_nothing_moves_without_any():
    joints, mask = random(12, 22, 3), torch.zeros(12, 22, 3, dtype=torch.bool)
    same = project_on_targets(joints, joints, mask, nowhere(12), HUMANML3D)
    assert torch.equal(same, joints)
    mask[3, 20, 2], mask[9, 0, [0, 2]] = True, True
    targets = joints + 0.2
    moved = project_on_targets(joints, targets, mask, nowhere(12), HUMANML3D)
    assert torch.equal(moved[mask], targets[mask])
    assert torch.equal(moved[..., 1], joints[..., 1])
    assert (moved - joints)[..., [0, 2]].abs().amin() > 0


def test_planted_feet_move_alike():
    joints, mask, planted = random(12, 22, 3), torch.zeros(12, 22, 3, dtype=torch.bool), nowhere(12)
    mask[5, 0] = planted[3:8, 10] = True
    change = project_on_targets(joints, joints + 0.3, mask, planted, HUMANML3D) - joints
    free = project_on_targets(joints, joints + 0.3, mask, planted & False, HUMANML3D) - joints
    steps = [x[3:9, 10].diff(dim=0).norm(dim=-1).max() for x in (change, free)]
    assert steps[0] < 0.05 * steps[1]


def test_a_chain_of_blocks_is_solved_as_the_dense_system():
    frames, size = 5, 4
    half = random(frames, size, size)
    blocks = half @ half.mT + torch.eye(size)
    ties, right = random(frames - 1, size, seed=1).abs(), random(frames, size, seed=2)
    blocks[:-1] += torch.diag_embed(ties)
    blocks[1:] += torch.diag_embed(ties)
    dense = torch.block_diag(*blocks)
    for frame, tie in enumerate(ties):
        here, there = slice(size * frame, size * (frame + 1)), slice(size * (frame + 1), size * (frame + 2))
        dense[here, there] -= torch.diag(tie)
        dense[there, here] -= torch.diag(tie)
    expected = torch.linalg.solve(dense, right.flatten()).unflatten(0, (frames, size))
    torch.testing.assert_close(solve_chain(blocks, ties, right), expected)


def test_bones_get_their_lengths_and_held_coordinates_stay(walk):
    joints = walk(20).double()
    bent = joints + 0.02 * random(20, 22, 3, seed=1)
    held = torch.zeros(20, 22, 3, dtype=torch.bool)
    held[7, 20], held[:, 0, 1] = True, True
    moved = restore_bones(bent, LENGTHS, held, nowhere(20), HUMANML3D)
    assert bone_error(moved) < TENTH_OF_A_MILLIMETRE
    assert torch.equal(moved[held], bent[held])
    assert (moved - bent).abs().max() < 0.1


def test_feet_that_slide_while_they_stand_are_stopped_and_nothing_shakes(walk):
    joints = walk(30).double()
    joints[10:20, 10] = joints[10, 10] + torch.linspace(0, 0.05, 10)[:, None] * torch.tensor([1.0, 0, 0])
    bent = joints + 0.01 * random(30, 22, 3, seed=1)
    planted = nowhere(30)
    planted[10:19, 10] = True
    moved = restore_bones(bent, LENGTHS, torch.zeros(30, 22, 3, dtype=torch.bool), planted, HUMANML3D)
    steps, before = (x[10:20, 10].diff(dim=0).norm(dim=-1).mean() for x in (moved, bent))
    assert steps < 0.5 * before
    jerk, shaken = (x.diff(n=3, dim=0).norm(dim=-1).mean() for x in (moved, bent))
    assert jerk < shaken
    assert bone_error(moved) < TENTH_OF_A_MILLIMETRE


@pytest.fixture
def standing():
    """Joints, held, planted of a body on straight legs: feet planted, pelvis and hips held 3 cm too high."""
    places = [torch.zeros(3)]
    for joint, offset in enumerate(HUMANML3D.rest_offsets()[1:], start=1):
        places.append(places[PARENTS[joint]] + offset)
    joints = torch.stack(places).double().repeat(41, 1, 1)
    joints[:, [0, 1, 2, 3, 6, 9], 1] += 0.03
    joints += 0.01 * random(41, 22, 3)
    for hip in (1, 2):  # what is held lies apart as its bones do
        side = joints[:, hip] - joints[:, 0]
        joints[:, hip] = joints[:, 0] + side / side.norm(dim=-1, keepdim=True) * LENGTHS[hip]
    held, planted = torch.zeros(41, 22, 3, dtype=torch.bool), nowhere(41)
    held[:, :3] = planted[:-1, list(FEET)] = True
    return joints, held, planted


def test_a_clip_on_straight_legs_gets_its_bones(standing):
    """It used to swing about: without damping and lighter feet bones stay wrong by a centimetre here."""
    joints, held, planted = standing
    moved = restore_bones(joints, LENGTHS, held, planted, HUMANML3D)
    assert bone_error(moved) < TENTH_OF_A_MILLIMETRE
    assert torch.equal(moved[held], joints[held])
    slides = (moved - joints)[:, list(FEET)].norm(dim=-1)
    assert slides.max() < 0.1


@both_backends
def test_steps_of_a_clip_on_straight_legs_are_damped(standing, backend):
    """Without, the worst bone is 4 cm wrong after them."""
    joints, held, planted = standing
    moved = smooth_bones(
        joints, LENGTHS.double(), held, planted,
        parents=PARENTS, feet=FEET, toes=TOES, enough=2e-3, steps=6, backend=backend,
    )  # fmt: skip
    assert bone_error(moved) < 0.01


@both_backends
def test_single_frames_on_straight_legs_get_their_bones(standing, backend):
    """With feet heavier than knees to the end, some frames stay 2 cm wrong."""
    joints, held, planted = standing
    moved = frame_bones(
        joints, LENGTHS.double(), held, planted,
        parents=PARENTS, feet=FEET, enough=1e-5, steps=40, backend=backend,
    )  # fmt: skip
    assert bone_error(moved) < 2e-5
