"""What must hold for any motion: batches, padding, turns, shifts, mirrors, threads."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from controlmm import ops

pytestmark = pytest.mark.skipif(not ops.available_isas(), reason="the C++ extension is not built")

ROUNDING = {"rtol": 1e-9, "atol": 1e-9}  # float64, after a rotation worked out in another order
seeds = st.integers(0, 10_000)
frames = st.integers(1, 40)
QUICK = settings(max_examples=15, deadline=None)


def motion(seed, batch, length, dtype=torch.float64):
    features = torch.randn(
        batch, length, 263, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    features[..., :3] *= 0.1
    return features.to(dtype)


def turned(points, angle):
    cos, sin = math.cos(angle), math.sin(angle)
    x, y, z = points.unbind(-1)
    return torch.stack([cos * x + sin * z, y, cos * z - sin * x], dim=-1)


def scene(turn=0.0, shift=(0.0, 0.0, 0.0), mirror=1.0):
    def place(*point):
        moved = torch.tensor(point, dtype=torch.float64) * torch.tensor([mirror, 1, 1])
        return turned(moved, turn) + torch.tensor(shift, dtype=torch.float64)

    def direct(*vector):
        return turned(torch.tensor(vector, dtype=torch.float64) * torch.tensor([mirror, 1, 1]), turn)

    axes = torch.stack([direct(0.6, 0, 0.8), direct(0, 1, 0), direct(-0.8, 0, 0.6)], dim=-1)
    return [
        ops.Sphere(place(0.1, 0.5, 0.2), 0.7),
        ops.Capsule(place(-1, 0, 0), place(1, 1, 0.5), 0.4),
        ops.Box(place(0.3, 0.5, -0.2), (0.6, 0.4, 0.9), axes),
        ops.Plane(place(0, 0.3, 0.4), direct(0.2, 0.1, 1)),
        ops.HalfSpace(place(0, 0.1, 0), direct(0.1, 1, -0.2)),
    ]


@QUICK
@given(seed=seeds, length=frames, dtype=st.sampled_from([torch.float32, torch.float64]))
def test_a_batch_of_one_is_a_slice_of_a_batch(seed, length, dtype):
    features = motion(seed, 3, length, dtype)
    joints = ops.recover_joints(features)
    targets, mask = torch.zeros_like(joints), joints > 0
    losses = ops.masked_consistency_loss(joints, targets, mask, reduction="clip")
    depths = ops.obstacle_loss(joints, ops.pack_obstacles(scene(), dtype=dtype), margin=0.2)
    for b in range(3):
        alone = slice(b, b + 1)
        assert torch.equal(ops.recover_joints(features[alone]), joints[alone])
        assert torch.equal(
            ops.masked_consistency_loss(joints[alone], targets[alone], mask[alone], reduction="clip"),
            losses[alone],
        )
        packed = ops.pack_obstacles(scene(), dtype=dtype)
        assert torch.equal(ops.obstacle_loss(joints[alone], packed, margin=0.2), depths[alone])


@QUICK
@given(seed=seeds, length=frames, padding=st.integers(1, 20))
def test_padding_frames_change_nothing(seed, length, padding):
    features = motion(seed, 2, length + padding)
    short, long = ops.recover_joints(features[:, :length]), ops.recover_joints(features)
    assert torch.equal(long[:, :length], short)
    mask = torch.zeros(2, length + padding, 22, dtype=torch.bool)
    mask[:, :length] = short[..., 0] > 0
    for norm in ("l2", "l1", "mse"):
        padded = ops.masked_consistency_loss(long, torch.zeros_like(long), mask, norm=norm)
        plain = ops.masked_consistency_loss(short, torch.zeros_like(short), mask[:, :length], norm=norm)
        torch.testing.assert_close(
            padded, plain, rtol=1e-14, atol=0
        )  # tiles of sixteen joints start elsewhere
    lengths = torch.tensor([length, length])
    assert torch.equal(ops.obstacle_loss(long, scene(), lengths=lengths), ops.obstacle_loss(short, scene()))


@QUICK
@given(seed=seeds, angle=st.floats(-3.1, 3.1), shift=st.tuples(*[st.floats(-3, 3)] * 3))
def test_turning_and_shifting_the_whole_scene_changes_no_loss(seed, angle, shift):
    joints = ops.recover_joints(motion(seed, 1, 9))
    moved = turned(joints, angle) + torch.tensor(shift, dtype=torch.float64)
    torch.testing.assert_close(
        ops.obstacle_loss(moved, scene(angle, shift), margin=0.3),
        ops.obstacle_loss(joints, scene(), margin=0.3),
        **ROUNDING,
    )  # fmt: skip
    mask = joints[..., 0] > 0
    targets = torch.zeros_like(joints)
    moved_targets = turned(targets, angle) + torch.tensor(shift, dtype=torch.float64)
    torch.testing.assert_close(
        ops.masked_consistency_loss(moved, moved_targets, mask),
        ops.masked_consistency_loss(joints, targets, mask),
        **ROUNDING,
    )  # fmt: skip


@QUICK
@given(seed=seeds)
def test_mirroring_the_scene_changes_no_loss(seed):
    joints = ops.recover_joints(motion(seed, 1, 9))
    mirrored = joints * torch.tensor([-1.0, 1, 1], dtype=torch.float64)
    torch.testing.assert_close(
        ops.obstacle_loss(mirrored, scene(mirror=-1.0), margin=0.3),
        ops.obstacle_loss(joints, scene(), margin=0.3),
        **ROUNDING,
    )  # fmt: skip


@QUICK
@given(seed=seeds, turn=st.floats(-1.5, 1.5))
def test_an_extra_turn_in_the_first_step_turns_all_later_frames(seed, turn):
    features = motion(seed, 1, 12)
    features[:, 0, 1:3] = 0  # the first step stays in place, so that all later frames turn about the origin
    more = features.clone()
    more[:, 0, 0] += turn / 2  # half the turn is stored
    plain, result = ops.recover_joints(features), ops.recover_joints(more)
    torch.testing.assert_close(result[:, 1:], turned(plain[:, 1:], -turn), **ROUNDING)
    assert torch.equal(result[:, :1], plain[:, :1])


@QUICK
@given(seed=seeds)
def test_the_mirrored_walk_is_the_mirror_image(seed):
    features = motion(seed, 1, 20)
    mirrored = features.clone()
    mirrored[..., 0] *= -1  # yaw
    mirrored[..., 1] *= -1  # sideways velocity
    mirrored[..., 4:67:3] *= -1  # x of every joint
    expected = ops.recover_joints(features) * torch.tensor([-1.0, 1, 1], dtype=torch.float64)
    torch.testing.assert_close(ops.recover_joints(mirrored), expected, **ROUNDING)


def test_threads_change_no_bit():
    features = motion(1, 64, 196, torch.float32).requires_grad_()
    logits, codebook = torch.randn(64, 49, 128, generator=torch.Generator().manual_seed(0)), torch.eye(128)

    def everything():
        joints = ops.recover_joints(features)
        loss = ops.masked_consistency_loss(joints, torch.zeros_like(joints), joints > 0)
        loss = loss + ops.obstacle_loss(joints, scene(), margin=0.2).sum()
        (gradient,) = torch.autograd.grad(loss, features)
        return (
            joints.detach(),
            loss.detach(),
            gradient,
            *ops.gumbel_straight_through(logits, codebook, seed=5),
        )

    kept = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        alone = everything()
        torch.set_num_threads(3)
        for mine, single in zip(everything(), alone, strict=True):
            assert torch.equal(mine, single)
    finally:
        torch.set_num_threads(kept)
