"""recover_joints: the kernels against the plain-torch specification, on every instruction set and dtype."""

from dataclasses import dataclass

import pytest
import torch

from controlmm import ops
from controlmm.ops.reference import recover_joints_reference

# Against the reference in float64. Float32: a few roundings of positions of order 1 m, and of gradients whose
# suffix sums over the clip are of order 100.
POSITION_TOLERANCE = {
    torch.float32: {"rtol": 1e-6, "atol": 1e-6},
    torch.float64: {"rtol": 1e-12, "atol": 1e-12},
}
GRADIENT_TOLERANCE = {
    torch.float32: {"rtol": 1e-5, "atol": 1e-4},
    torch.float64: {"rtol": 1e-11, "atol": 1e-11},
}


@dataclass(frozen=True)
class Case:
    name: str
    batch: int = 2
    frames: int = 37
    joints: int = 22
    dim: int = 263
    layout: str = "frame_major"

    def __str__(self):
        return self.name

    def features(self, dtype):
        generator = torch.Generator().manual_seed(7)
        features = torch.randn(self.batch, self.frames, self.dim, generator=generator, dtype=torch.float64)
        features[..., :3] *= 0.05
        return LAYOUTS[self.layout](features.to(dtype))


LAYOUTS = {
    "frame_major": lambda x: x,
    "channel_major": lambda x: x.transpose(1, 2).contiguous().transpose(1, 2),
    "batch_last": lambda x: x.permute(1, 2, 0).contiguous().permute(2, 0, 1),
    "every_second_channel": lambda x: x.repeat_interleave(2, dim=-1)[..., ::2],
    "same_frame_repeated": lambda x: x[:, :1].expand_as(x),
    "same_clip_repeated": lambda x: x[:1].expand_as(x),
    "one_value_repeated": lambda x: x[:1, :1, 4:5].expand_as(x) * 0.01,
    "offset_by_one": lambda x: torch.nn.functional.pad(x, (1, 0))[..., 1:],
}

CASES = [
    Case("humanml3d"),
    Case("kit", joints=21, dim=251),
    Case("full_length", batch=1, frames=196),
    Case("no_clip", batch=0),
    Case("no_frame", frames=0),
    Case("one_frame", frames=1),
    Case("two_frames", frames=2),
    Case("sixteen_frames", frames=16),
    Case("kinematic_channels_only", dim=67),
    Case("one_joint", joints=1, dim=4),
    Case("two_joints", joints=2, dim=7),
    Case("six_joints_exactly_one_block", joints=17, dim=52),
    Case("many_joints", joints=52, dim=623),
    *(Case(layout, layout=layout) for layout in LAYOUTS),
]


def value_and_gradient(function, features, cotangent):
    leaf = features.detach().requires_grad_()
    joints = function(leaf)
    (gradient,) = torch.autograd.grad(joints, leaf, cotangent)
    return joints.detach(), gradient


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("case", CASES, ids=str)
def test_agrees_with_reference(case, dtype, isa):
    features = case.features(dtype)
    shape = (case.batch, case.frames, case.joints, 3)
    cotangent = torch.randn(shape, generator=torch.Generator().manual_seed(8), dtype=torch.float64)

    actual, actual_gradient = value_and_gradient(
        lambda x: ops.recover_joints(x, joints=case.joints, backend="native"), features, cotangent.to(dtype)
    )
    expected, expected_gradient = value_and_gradient(
        lambda x: recover_joints_reference(x, case.joints), features.double(), cotangent.to(dtype).double()
    )
    torch.testing.assert_close(actual.double(), expected, **POSITION_TOLERANCE[dtype])
    torch.testing.assert_close(actual_gradient.double(), expected_gradient, **GRADIENT_TOLERANCE[dtype])
    assert actual.shape == shape


def test_channels_past_the_joints_get_exactly_zero_gradient(isa):
    features = Case("humanml3d").features(torch.float32).requires_grad_()
    ops.recover_joints(features, backend="native").sum().backward()
    assert torch.equal(features.grad[..., 67:], torch.zeros_like(features.grad[..., 67:]))


def test_gradcheck(isa):
    features = torch.randn(2, 4, 12, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.3
    torch.autograd.gradcheck(
        lambda x: ops.recover_joints(x, joints=3, backend="native"), features.requires_grad_()
    )


@pytest.mark.parametrize("layout", ["contiguous", "expanded", "transposed"])
def test_gradient_accepts_any_strides_of_the_cotangent(layout, isa):
    features = Case("humanml3d").features(torch.float64)
    dense = torch.randn(2, 37, 22, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    cotangent = {
        "contiguous": dense,
        "expanded": dense[:, :, :1].expand_as(dense),
        "transposed": dense.permute(3, 1, 2, 0).contiguous().permute(3, 1, 2, 0),
    }[layout]
    _, actual = value_and_gradient(lambda x: ops.recover_joints(x, backend="native"), features, cotangent)
    _, expected = value_and_gradient(recover_joints_reference, features, cotangent)
    torch.testing.assert_close(actual, expected, **GRADIENT_TOLERANCE[torch.float64])


def test_every_instruction_set_gives_the_same_bits():
    features = Case("full_length", batch=3, frames=196).features(torch.float32)
    cotangent = torch.randn(3, 196, 22, 3, generator=torch.Generator().manual_seed(4))
    results = []
    for isa in ops.available_isas():
        with ops.use_isa(isa):
            results.append(
                value_and_gradient(lambda x: ops.recover_joints(x, backend="native"), features, cotangent)
            )
    for joints, gradient in results[1:]:
        assert torch.equal(joints, results[0][0])
        assert torch.equal(gradient, results[0][1])


def test_nan_in_one_joint_stays_in_that_joint(isa):
    features = Case("humanml3d").features(torch.float32)
    features[0, 5, 4 + 3 * 9 + 1] = float("nan")  # height of joint 10
    joints = ops.recover_joints(features, backend="native")
    expected = torch.zeros(2, 37, 22, 3, dtype=torch.bool)
    expected[0, 5, 10, 1] = True
    assert torch.equal(joints.isnan(), expected)
    features[0, 5, 4 + 3 * 9] = float("inf")  # its x reaches x and z, not the height of a neighbour
    joints = ops.recover_joints(features, backend="native")
    expected[0, 5, 10] = True
    assert torch.equal(~joints.isfinite(), expected)


@pytest.mark.parametrize("scale", [1e3, 1e7], ids=["many_turns", "absurd"])
def test_many_turns_keep_their_angle(scale, isa):
    features = torch.zeros(1, 64, 263, dtype=torch.float64)
    features[..., 0] = scale * torch.randn(
        64, generator=torch.Generator().manual_seed(5), dtype=torch.float64
    )
    features[..., 4] = 1
    joints = ops.recover_joints(features, backend="native")
    # Sums of angles of this size round differently, hence the looser tolerance.
    torch.testing.assert_close(joints, recover_joints_reference(features), rtol=0, atol=1e-9 * scale / 1e3)
