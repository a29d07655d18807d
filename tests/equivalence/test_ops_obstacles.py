"""obstacle_loss: kernels against the plain-torch distances, and both against distances worked out by hand."""

import math

import pytest
import torch

from controlmm import ops

# Float32: a few roundings of distances of order 1 m. Random points avoid the kinks where the two may differ.
TOLERANCE = {torch.float32: {"rtol": 1e-5, "atol": 1e-6}, torch.float64: {"rtol": 1e-11, "atol": 1e-12}}
TURN = torch.tensor([[math.cos(0.7), 0, math.sin(0.7)], [0, 1, 0], [-math.sin(0.7), 0, math.cos(0.7)]])
BATCH, FRAMES, JOINTS = 2, 19, 5


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


SCENES = {
    "sphere": [ops.Sphere((0.1, 0.2, 0.3), 1.2)],
    "moving_sphere": [ops.Sphere(random(FRAMES, 3), 0.9)],
    "sphere_growing_in_each_clip": [ops.Sphere(random(BATCH, FRAMES, 3), random(BATCH, FRAMES).abs())],
    "capsule": [ops.Capsule((-1, 0, 0), (1, 0.5, 0.2), 0.7)],
    "point_capsule": [ops.Capsule((0.3, 0, 0), (0.3, 0, 0), 1.1)],
    "moving_capsule": [ops.Capsule(random(FRAMES, 3), random(FRAMES, 3, seed=1), 0.6)],
    "box": [ops.Box((0.1, 0, -0.2), (0.8, 1.1, 0.9))],
    "turned_box": [ops.Box((0.1, 0, -0.2), (1.4, 0.6, 0.9), TURN)],
    "moving_box": [ops.Box(random(FRAMES, 3), (0.9, 0.9, 1.3), TURN)],
    "plane": [ops.Plane((0, 0.2, 0), (1, 2, -1))],
    "half_space": [ops.HalfSpace((0, 0.1, 0), (0.2, 1, 0))],
    "rising_floor": [
        ops.HalfSpace(torch.linspace(-1, 1, FRAMES)[:, None] * torch.tensor([0.0, 1.0, 0.0]), (0, 1, 0))
    ],
    "height_field": [ops.HeightField(random(6, 9), (-1.5, -1.2), (0.5, 0.3))],
    "two_height_fields": [
        ops.HeightField(random(2, 2), (-1.5, -1.2), (3.0, 2.4)),
        ops.HeightField(random(7, 3, seed=2), (-1.5, -1.2), (0.5, 0.7)),
    ],
    "none": [],
}
SCENES["all_kinds"] = [obstacle for scene in SCENES.values() for obstacle in scene]

OPTIONS = {
    "plain": {},
    "margin": {"margin": 0.3},
    "joint_radius": {"joint_radius": 0.2},
    "radius_of_each_joint": {"joint_radius": torch.linspace(0, 0.4, JOINTS, dtype=torch.float64)},
    "joint_subset": {"joint_indices": [0, 3]},
    "lengths": {"lengths": torch.tensor([7, 0])},
    "sum": {"reduction": "sum"},
}


def joints_with_layout(dtype, layout="row_major"):
    joints = random(BATCH, FRAMES, JOINTS, 3, seed=3).to(dtype)
    return joints if layout == "row_major" else ops.frames_last(joints)


def value_and_gradient(joints, scene, backend, **options):
    leaf = joints.detach().requires_grad_()
    loss = ops.obstacle_loss(leaf, scene, backend=backend, **options)
    weights = torch.linspace(0.5, 2, BATCH, dtype=loss.dtype)
    (gradient,) = torch.autograd.grad((loss * weights).sum(), leaf)
    return loss.detach(), gradient


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("layout", ["row_major", "frames_last"])
@pytest.mark.parametrize("scene", SCENES, ids=str)
def test_agrees_with_reference(scene, layout, dtype, isa):
    joints = joints_with_layout(dtype, layout)
    actual = value_and_gradient(joints, SCENES[scene], "native")
    expected = value_and_gradient(joints.double(), SCENES[scene], "reference")
    for mine, reference in zip(actual, expected, strict=True):
        torch.testing.assert_close(mine.double(), reference, **TOLERANCE[dtype])


@pytest.mark.parametrize("option", OPTIONS, ids=str)
def test_options_agree_with_reference(option, isa):
    joints = joints_with_layout(torch.float64)
    actual = value_and_gradient(joints, SCENES["all_kinds"], "native", **OPTIONS[option])
    expected = value_and_gradient(joints, SCENES["all_kinds"], "reference", **OPTIONS[option])
    for mine, reference in zip(actual, expected, strict=True):
        torch.testing.assert_close(mine, reference, **TOLERANCE[torch.float64])


# (obstacle, point, signed distance), worked out by hand.
BY_HAND = {
    "inside a ball": (ops.Sphere((0, 1, 0), 2.0), (0, 1, 0.5), -1.5),
    "outside a ball": (ops.Sphere((0, 1, 0), 2.0), (3, 1, 4), 3.0),
    "beside a rod": (ops.Capsule((0, 0, 0), (0, 2, 0), 0.25), (1, 1, 0), 0.75),
    "past the end of a rod": (ops.Capsule((0, 0, 0), (0, 2, 0), 0.25), (3, 6, 0), 4.75),
    "inside a box": (ops.Box((1, 1, 1), (1, 2, 3)), (1.75, 1, 1), -0.25),
    "off a box edge": (ops.Box((0, 0, 0), (1, 1, 1)), (4, 5, 0), 5.0),
    "off a turned box": (
        ops.Box((0, 0, 0), (1, 1, 1), [[0.6, 0, 0.8], [0, 1, 0], [-0.8, 0, 0.6]]),
        (3, 0, -4),  # five along the first axis of the box
        4.0,
    ),
    "front of a wall": (ops.Plane((0, 0, 2), (0, 0, 3)), (9, 9, 5), 3.0),
    "behind a wall": (ops.Plane((0, 0, 2), (0, 0, 3)), (9, 9, -1), 3.0),
    "under a floor": (ops.HalfSpace((0, 0.5, 0), (0, 1, 0)), (1, 0.2, 1), -0.3),
    "over a slope": (ops.HeightField([[0.0, 0.0], [2.0, 2.0]], (0, 0), (1, 1)), (0.25, 1.0, 0.5), 0.5),
    "over the border of a slope": (ops.HeightField([[0.0, 0.0], [2.0, 2.0]], (0, 0), (1, 1)), (5, 3, 9), 1.0),
}


@pytest.mark.parametrize("backend", ["native", "reference"])
@pytest.mark.parametrize("name", BY_HAND)
def test_distances_worked_out_by_hand(name, backend):
    obstacle, point, distance = BY_HAND[name]
    joints = torch.tensor(point, dtype=torch.float64).reshape(1, 1, 1, 3)
    margin = 10.0  # reaches every point, so that the loss shows the distance
    loss = ops.obstacle_loss(joints, [obstacle], margin=margin, backend=backend)
    # Parameters given as Python numbers are float32: 0.6, 0.8 and 0.2 are rounded.
    assert margin - loss.item() == pytest.approx(distance, abs=1e-6)


@pytest.mark.parametrize("scene", ["sphere", "capsule", "turned_box", "plane", "half_space", "height_field"])
def test_gradcheck(scene):
    joints = joints_with_layout(torch.float64)[:, :4, :2].requires_grad_()
    torch.autograd.gradcheck(
        lambda x: ops.obstacle_loss(x, SCENES[scene], margin=0.5, backend="native"), joints
    )


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_clips_clear_of_everything_give_exactly_zero(backend, isa):
    joints = torch.full((BATCH, FRAMES, JOINTS, 3), 50.0, requires_grad=True)
    loss = ops.obstacle_loss(
        joints, [ops.Sphere((0, 0, 0), 1.0), ops.Box((0, 0, 0), (1, 1, 1))], backend=backend
    )
    loss.sum().backward()
    assert torch.equal(loss, torch.zeros(BATCH))
    assert torch.equal(joints.grad, torch.zeros_like(joints))


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_frames_past_the_length_may_hold_nan(backend, isa):
    joints = joints_with_layout(torch.float64)
    joints[:, 10:] = torch.nan
    lengths = torch.tensor([10, 4])
    loss, gradient = value_and_gradient(joints, SCENES["sphere"], backend, lengths=lengths)
    assert loss.isfinite().all()
    assert torch.equal(gradient[:, 10:], torch.zeros_like(gradient[:, 10:]))
    assert gradient.isfinite().all()


@pytest.mark.parametrize("backend", ["native", "reference"])
@pytest.mark.parametrize("scene", ["sphere", "capsule", "box", "plane", "half_space", "height_field"])
def test_nan_joint_shows_in_the_loss_and_stays_in_its_joint(scene, backend, isa):
    joints = joints_with_layout(torch.float64)
    joints[0, 3, 1] = torch.nan
    loss, gradient = value_and_gradient(joints, SCENES[scene], backend)
    others = torch.ones(BATCH, FRAMES, JOINTS, dtype=torch.bool)
    others[0, 3, 1] = False
    assert loss.isnan().tolist() == [True, False]
    assert gradient[others].isfinite().all()


def test_center_of_a_ball_has_no_gradient_instead_of_nan(isa):
    _, gradient = value_and_gradient(torch.zeros(BATCH, 1, 1, 3), [ops.Sphere((0, 0, 0), 1.0)], "native")
    assert torch.equal(gradient, torch.zeros_like(gradient))


def test_obstacles_that_want_gradients_get_them_from_the_reference():
    center = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    joints = joints_with_layout(torch.float64)
    ops.obstacle_loss(joints, [ops.Sphere(center, 2.0)]).sum().backward()
    assert center.grad.abs().sum() > 0
    with pytest.raises(ValueError, match="an obstacle requires gradients"):
        ops.obstacle_loss(joints, [ops.Sphere(center, 2.0)], backend="native")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"margin": -0.1}, r"`margin` must be at least 0 m, got -0.1"),
        ({"joint_radius": -1.0}, r"`joint_radius` must be at least 0 m, got -1.0"),
        ({"joint_indices": [5]}, r"`joint_indices` must lie between 0 and 4, got \[5\]"),
        ({"lengths": torch.tensor([20, 3])}, r"`lengths` must be 2 values between 0 and 19, got \[20, 3\]"),
        ({"reduction": "max"}, r"`reduction` must be one of"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_impossible_arguments_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        ops.obstacle_loss(joints_with_layout(torch.float32), SCENES["sphere"], **change)


def test_impossible_obstacles_are_refused():
    with pytest.raises(ValueError, match="`radius` must not be negative, got -1 m"):
        ops.Sphere((0, 0, 0), -1.0)
    with pytest.raises(ValueError, match=r"`center` must have shape \(3,\)"):
        ops.Sphere((0, 0), 1.0)
    with pytest.raises(ValueError, match="`center` must be finite"):
        ops.Sphere((0, 0, math.nan), 1.0)
    with pytest.raises(ValueError, match="`normal` must have a length above 0"):
        ops.Plane((0, 0, 0), (0, 0, 0))
    with pytest.raises(ValueError, match="`rotation` must be orthonormal"):
        ops.Box((0, 0, 0), (1, 1, 1), torch.ones(3, 3))
    with pytest.raises(ValueError, match="`heights` must have at least 2 x 2 samples"):
        ops.HeightField([[1.0, 2.0]], (0, 0), (1, 1))
    with pytest.raises(ValueError, match=r"must move over one number of frames, got \[3, 4\]"):
        ops.pack_obstacles([ops.Sphere(torch.zeros(3, 3), 1.0), ops.Sphere(torch.zeros(4, 3), 1.0)])
    with pytest.raises(ValueError, match=r"must move over the 2 clips and 19 frames"):
        ops.obstacle_loss(joints_with_layout(torch.float32), [ops.Sphere(torch.zeros(3, 3), 1.0)])
    with pytest.raises(TypeError, match="`obstacles` must hold obstacles such as Sphere, got str"):
        ops.pack_obstacles(["sphere"])
