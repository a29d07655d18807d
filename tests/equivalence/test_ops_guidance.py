"""guidance_value_and_grad: the fused kernel against autograd through the separate operators."""

from dataclasses import dataclass

import pytest
import torch

from controlmm import ops

# Gradients are suffix sums over the clip; in float32 the de-normalisation adds a rounding of the features.
TOLERANCE = {torch.float32: {"rtol": 2e-4, "atol": 2e-5}, torch.float64: {"rtol": 1e-10, "atol": 1e-11}}
SCENE = [
    ops.Sphere((0.1, 0.2, 0.3), 1.2),
    ops.Capsule((-1, 0, 0), (1, 0.5, 0.2), 0.7),
    ops.Box((0.1, 0, -0.2), (0.8, 1.1, 0.9)),
    ops.HalfSpace((0, 0.1, 0), (0.2, 1, 0)),
]


@dataclass(frozen=True)
class Case:
    name: str
    batch: int = 2
    frames: int = 21
    joints: int = 22
    dim: int = 263
    density: float = 0.2
    norm: str = "l2"
    per_coordinate: bool = False
    layout: str = "channel_major"
    with_obstacles: bool = False

    def __str__(self):
        return self.name

    def inputs(self, dtype):
        generator = torch.Generator().manual_seed(21)

        def draw(*shape):
            return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)

        decoded, mean, std = (
            draw(self.batch, self.dim, self.frames),
            0.1 * draw(self.dim),
            draw(self.dim).abs(),
        )
        std[:3] *= 0.1
        if self.layout == "frame_major":
            decoded = decoded.transpose(1, 2).contiguous().transpose(1, 2)
        targets = draw(self.batch, self.frames, self.joints, 3)
        mask_shape = targets.shape if self.per_coordinate else targets.shape[:3]
        mask = torch.rand(mask_shape, generator=generator) < self.density
        targets = torch.where(mask if self.per_coordinate else mask[..., None], targets, torch.nan)
        if self.layout == "frames_last":
            targets = ops.frames_last(targets)
            mask = ops.frames_last(mask) if self.per_coordinate else mask.mT.contiguous().mT
        options = {"obstacles": SCENE, "obstacle_weight": 0.7, "margin": 0.1} if self.with_obstacles else {}
        return (decoded, targets, mask), {"mean": mean, "std": std, "norm": self.norm, **options}


CASES = [
    Case("l2"),
    Case("l1", norm="l1"),
    Case("mse", norm="mse"),
    Case("per_coordinate", per_coordinate=True),
    Case("per_coordinate_l1", per_coordinate=True, norm="l1"),
    Case("frames_last", layout="frames_last"),
    Case("frames_last_per_coordinate", layout="frames_last", per_coordinate=True),
    Case("frame_major_decoder", layout="frame_major"),
    Case("dense", density=1.1),
    Case("nothing_controlled", density=-1),
    Case("kit", joints=21, dim=251),
    Case("full_length", frames=196, batch=1, layout="frames_last"),
    Case("one_frame", frames=1),
    Case("sixteen_frames", frames=16),
    Case("one_joint", joints=1, dim=4),
    Case("kinematic_channels_only", dim=67),
    Case("no_clip", batch=0),
    Case("obstacles", with_obstacles=True),
    Case("obstacles_alone", with_obstacles=True, density=-1),
]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("case", CASES, ids=str)
def test_agrees_with_reference(case, dtype, isa):
    arguments, options = case.inputs(dtype)
    actual = ops.guidance_value_and_grad(*arguments, **options, backend="native")
    decoded, targets, mask = arguments
    wide = {
        key: value.double() if isinstance(value, torch.Tensor) else value for key, value in options.items()
    }
    expected = ops.guidance_value_and_grad(
        decoded.double(), targets.double(), mask, **wide, backend="reference"
    )
    for mine, reference in zip(actual, expected, strict=True):
        torch.testing.assert_close(mine.double(), reference, **TOLERANCE[dtype])


@pytest.mark.parametrize("case", [Case("l2"), Case("obstacles", with_obstacles=True)], ids=str)
def test_is_the_sum_of_the_separate_operators(case, isa):
    (decoded, targets, mask), options = case.inputs(torch.float64)
    decoded.requires_grad_()
    joints = ops.recover_joints(decoded.transpose(1, 2) * options["std"] + options["mean"])
    loss = ops.masked_consistency_loss(joints, targets, mask, reduction="clip")
    if case.with_obstacles:
        loss = loss + 0.7 * ops.obstacle_loss(joints, SCENE, margin=0.1)
    (gradient,) = torch.autograd.grad(loss.sum(), decoded)
    actual = ops.guidance_value_and_grad(decoded, targets, mask, **options, backend="native")
    torch.testing.assert_close(actual[0], loss.detach(), **TOLERANCE[torch.float64])
    torch.testing.assert_close(actual[1], gradient, **TOLERANCE[torch.float64])


def test_a_reused_gradient_buffer_forgets_the_joints_of_the_call_before(isa):
    (decoded, targets, mask), options = Case("dense", density=1.1).inputs(torch.float32)
    _, buffer = ops.guidance_value_and_grad(decoded, targets, mask, **options, backend="native")
    mask = torch.zeros_like(mask)
    mask[0, 3, 5] = True
    loss, gradient = ops.guidance_value_and_grad(
        decoded, targets, mask, **options, out=buffer, backend="native"
    )
    fresh_loss, fresh = ops.guidance_value_and_grad(decoded, targets, mask, **options, backend="native")
    assert gradient.data_ptr() == buffer.data_ptr()
    assert torch.equal(gradient, fresh)
    assert torch.equal(loss, fresh_loss)


def test_a_broken_joint_without_control_does_no_harm(isa):
    (decoded, targets, mask), options = Case("l2").inputs(torch.float32)
    mask[:, :, 7] = False
    decoded[:, 4 + 3 * 6 : 7 + 3 * 6] = torch.nan  # joint 7
    loss, gradient = ops.guidance_value_and_grad(decoded, targets, mask, **options, backend="native")
    assert loss.isfinite().all()
    assert gradient.isfinite().all()


def test_every_instruction_set_gives_the_same_bits():
    arguments, options = Case("long", frames=196, with_obstacles=True, layout="frames_last").inputs(
        torch.float32
    )
    results = []
    for isa in ops.available_isas():
        with ops.use_isa(isa):
            results.append(ops.guidance_value_and_grad(*arguments, **options, backend="native"))
    for loss, gradient in results[1:]:
        assert torch.equal(loss, results[0][0])
        assert torch.equal(gradient, results[0][1])


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_impossible_arguments_are_refused(backend):
    (decoded, targets, mask), options = Case("l2").inputs(torch.float32)
    with pytest.raises(ValueError, match=r"`decoded` must have shape \(B, D, T\)"):
        ops.guidance_value_and_grad(decoded[..., 1:], targets, mask, **options, backend=backend)
    short = {**options, "mean": options["mean"][:66], "std": options["std"][:66]}
    with pytest.raises(ValueError, match="must have at least 67 channels for the 22 joints"):
        ops.guidance_value_and_grad(decoded[:, :66], targets, mask, **short, backend=backend)
    with pytest.raises(ValueError, match=r"`mean` and `std` must have shape \(263,\)"):
        ops.guidance_value_and_grad(
            decoded, targets, mask, **{**options, "mean": torch.zeros(3)}, backend=backend
        )
    with pytest.raises(TypeError, match="must share one floating-point dtype"):
        ops.guidance_value_and_grad(decoded.double(), targets, mask, **options, backend=backend)
    with pytest.raises(ValueError, match="`out` must be a gradient from an earlier call"):
        ops.guidance_value_and_grad(decoded, targets, mask, **options, out=decoded[:1], backend=backend)
