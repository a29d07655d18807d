"""The same bits over runs, thread counts, places in a batch, paddings and instruction sets."""

import contextlib

import pytest
import torch

from controlmm import ops

pytestmark = pytest.mark.skipif(not ops.available_isas(), reason="the C++ extension is not built")

CLIPS, FRAMES = 24, 196  # enough work that two threads are used


def random(*shape, seed):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


FEATURES = random(CLIPS, FRAMES, 263, seed=0) * 0.2
DECODED = FEATURES.transpose(1, 2).contiguous()
TARGETS = ops.frames_last(random(CLIPS, FRAMES, 22, 3, seed=1))
MASK = random(CLIPS, FRAMES, 22, seed=2) > 0.5
MASK[:, :, 3] = True  # joints that are controlled everywhere, nowhere and here and there
MASK[:, :, 4] = False
MEAN, STD = torch.zeros(263), torch.full((263,), 1.5)
LOGITS, CODEBOOK = random(CLIPS, 49, 100, seed=3), random(100, 8, seed=4)


def path(seed):
    return random(3, seed=seed) * 0.3 + 0.02 * random(FRAMES, 3, seed=seed + 1).cumsum(0)


SCENE = ops.pack_obstacles(
    [
        ops.Sphere(path(10), 0.3),
        ops.Capsule(path(12), path(12) + 0.4, 0.2),
        ops.Box(path(14), (0.3, 0.4, 0.2), torch.linalg.qr(random(3, 3, seed=15))[0]),
        ops.Plane(path(16), (0.1, 0.9, 0.2)),
        ops.HalfSpace(path(18), (0.0, 1.0, 0.1)),
        ops.HeightField(0.1 * random(5, 6, seed=19), (-1.0, -1.0), (0.5, 0.5)),
    ]
)


def kinematics(clips):
    leaf = FEATURES[clips].clone().requires_grad_()
    joints = ops.recover_joints(leaf, backend="native")
    loss = ops.masked_consistency_loss(
        joints, TARGETS[clips], MASK[clips], reduction="clip", backend="native"
    )
    depth = ops.obstacle_loss(joints, SCENE, margin=0.1, backend="native")
    (gradient,) = torch.autograd.grad((loss + depth).sum(), leaf)
    return joints.detach(), loss.detach(), depth.detach(), gradient


def guidance(clips):
    return ops.guidance_value_and_grad(
        DECODED[clips], TARGETS[clips], MASK[clips], SCENE, mean=MEAN, std=STD, margin=0.1, backend="native"
    )


def control(clips):
    return ops.guidance_value_and_grad(
        DECODED[clips], TARGETS[clips], MASK[clips], mean=MEAN, std=STD, norm="l1", backend="native"
    )


def gumbel(clips):
    leaf = LOGITS[clips].clone().requires_grad_()
    rows, ids = ops.gumbel_straight_through(
        leaf, CODEBOOK, seed=7, first_clip=clips.start or 0, backend="native"
    )
    (gradient,) = torch.autograd.grad(rows.sum(), leaf)
    return rows.detach(), ids, gradient


EVERYTHING = slice(None)
OPERATORS = [kinematics, guidance, control, gumbel]


@contextlib.contextmanager
def threads(count):
    kept = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(kept)


def assert_same_bits(results, expected):
    for mine, other in zip(results, expected, strict=True):
        assert torch.equal(mine, other)


@pytest.mark.parametrize("operator", OPERATORS)
def test_two_runs(operator):
    assert_same_bits(operator(EVERYTHING), operator(EVERYTHING))


@pytest.mark.parametrize("operator", OPERATORS[:3])
def test_one_two_and_three_threads(operator):
    with threads(1):
        alone = operator(EVERYTHING)
    for count in (2, 3):
        with threads(count):
            assert_same_bits(operator(EVERYTHING), alone)


@pytest.mark.parametrize("operator", OPERATORS[:3])
def test_place_in_the_batch(operator):
    whole = operator(EVERYTHING)
    for first in (0, 1, CLIPS - 2):
        clips = slice(first, first + 2)
        assert_same_bits(operator(clips), [result[clips] for result in whole])


def test_place_in_the_batch_of_drawn_codes():
    rows, ids, _ = gumbel(EVERYTHING)  # its gradient goes through a matrix product of torch
    later_rows, later_ids, _ = gumbel(slice(5, 9))
    assert_same_bits((later_rows, later_ids), (rows[5:9], ids[5:9]))


@pytest.mark.parametrize("operator", OPERATORS)
def test_instruction_sets(operator):
    results = []
    for isa in ops.available_isas():
        with ops.use_isa(isa):
            results.append(operator(slice(0, 3)))
    for result in results[1:]:
        assert_same_bits(result, results[0])


@pytest.mark.parametrize("norm", ["l2", "l1", "mse"])
def test_frames_without_control_behind_a_clip_change_nothing(norm, isa):
    short, padded = slice(0, 50), slice(0, 77)
    mask = MASK[:2, padded].clone()
    mask[:, 50:] = False

    def losses(frames):
        return ops.guidance_value_and_grad(
            DECODED[:2, :, frames], TARGETS[:2, frames], mask[:, frames], mean=MEAN, std=STD, norm=norm
        )

    loss, gradient = losses(short)
    padded_loss, padded_gradient = losses(padded)
    assert torch.equal(padded_loss, loss)
    assert torch.equal(padded_gradient[..., short], gradient)
    assert not padded_gradient[..., 50:].any()


def test_booleans_of_any_byte_count_as_true(isa):
    bytes_ = MASK.to(torch.uint8) * torch.randint(
        1, 255, MASK.shape, generator=torch.Generator().manual_seed(9), dtype=torch.uint8
    )
    mask = ops.frames_last(bytes_[..., None].expand(*MASK.shape, 3)).view(torch.bool)
    expected = ops.frames_last(MASK[..., None].expand(*MASK.shape, 3))
    for controlled in (mask, mask[:, 3:5]):
        truth = expected if controlled is mask else expected[:, 3:5]
        frames = controlled.shape[1]
        arguments = {"mean": MEAN, "std": STD, "backend": "native"}
        assert_same_bits(
            ops.guidance_value_and_grad(DECODED[..., :frames], TARGETS[:, :frames], controlled, **arguments),
            ops.guidance_value_and_grad(DECODED[..., :frames], TARGETS[:, :frames], truth, **arguments),
        )


def test_a_broken_joint_far_from_a_box_shows_whatever_its_neighbours_do(isa):
    joints = torch.full((1, 40, 2, 3), 9.0)  # far away
    joints[0, 5, 0, 0] = torch.nan
    near = joints.clone()
    near[0, 6, 0] = 0.0  # the frame next to it touches, which must not decide
    box = [ops.Box((0.0, 0.0, 0.0), (0.5, 0.5, 0.5))]
    for positions in (joints, near):
        leaf = positions.clone().requires_grad_()
        loss = ops.obstacle_loss(leaf, box, backend="native")
        loss.sum().backward()
        assert loss.isnan()
        others = torch.ones(1, 40, 2, dtype=torch.bool)
        others[0, 5, 0] = False
        assert leaf.grad[others].isfinite().all()


def test_huge_values_stay_in_their_clip(isa):
    features = FEATURES[:3].clone()
    features[1] = 3e38
    joints = ops.recover_joints(features, backend="native")
    assert torch.equal(joints[0], ops.recover_joints(FEATURES[:1], backend="native")[0])
    assert torch.equal(joints[2], ops.recover_joints(FEATURES[2:3], backend="native")[0])
