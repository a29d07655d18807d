"""masked_consistency_loss: the kernels against the specification, on every instruction set and dtype."""

from dataclasses import dataclass

import pytest
import torch

from controlmm import ops
from controlmm.ops.reference import masked_consistency_loss_reference

# Sums run in double; float32 differs by the rounding of single distances.
TOLERANCE = {torch.float32: {"rtol": 2e-6, "atol": 1e-7}, torch.float64: {"rtol": 1e-13, "atol": 1e-14}}
NORMS = ["l2", "l1", "mse"]
REDUCTIONS = ["batch", "clip"]


@dataclass(frozen=True)
class Case:
    name: str
    batch: int = 3
    frames: int = 11
    joints: int = 22
    density: float = 0.3
    per_coordinate: bool = False
    is_strided: bool = False

    def __str__(self):
        return self.name

    def arguments(self, dtype):
        generator = torch.Generator().manual_seed(11)
        shape = (self.batch, self.frames, self.joints, 3)
        joints, targets = torch.randn(2, *shape, generator=generator, dtype=torch.float64).to(dtype)
        mask = torch.rand(shape if self.per_coordinate else shape[:3], generator=generator) < self.density
        if self.is_strided:
            joints = joints.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)
            targets = targets[:, :1].expand(shape)
        targets = torch.where(mask if self.per_coordinate else mask[..., None], targets, torch.nan)
        return joints, targets, mask


CASES = [
    Case("sparse"),
    Case("dense", density=1.1),
    Case("nothing_controlled", density=-1),
    Case("per_coordinate", per_coordinate=True),
    Case("strided", is_strided=True),
    Case("strided_per_coordinate", is_strided=True, per_coordinate=True),
    Case("one_joint", joints=1),
    Case("one_frame", frames=1),
    Case("no_clip", batch=0),
    Case("no_frame", frames=0),
    Case("kit_full_length", joints=21, frames=196, batch=2),
]


def value_and_gradients(function, joints, targets, cotangent):
    leaves = joints.detach().requires_grad_(), targets.detach().requires_grad_()
    loss = function(*leaves)
    return loss.detach(), *torch.autograd.grad(loss, leaves, cotangent)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("reduction", REDUCTIONS)
@pytest.mark.parametrize("case", CASES, ids=str)
def test_agrees_with_reference(case, reduction, norm, dtype, isa):
    joints, targets, mask = case.arguments(dtype)
    cotangent = torch.tensor(0.7) if reduction == "batch" else torch.linspace(-1, 2, case.batch)
    full_mask = mask if case.per_coordinate else mask[..., None].expand(joints.shape)

    actual = value_and_gradients(
        lambda j, t: ops.masked_consistency_loss(
            j, t, mask, norm=norm, reduction=reduction, backend="native"
        ),
        joints, targets, cotangent.to(dtype),
    )  # fmt: skip
    expected = value_and_gradients(
        lambda j, t: masked_consistency_loss_reference(j, t, full_mask, norm, reduction),
        joints.double(), targets.double(), cotangent.double(),
    )  # fmt: skip
    for mine, reference in zip(actual, expected, strict=True):
        torch.testing.assert_close(mine.double(), reference, **TOLERANCE[dtype])


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_worked_example(backend, isa):
    joints = torch.zeros(1, 2, 2, 3)
    targets = torch.tensor([[[[3.0, 4.0, 0.0], [9.0, 9.0, 9.0]], [[1.0, 2.0, 2.0], [0.0, 7.0, 0.0]]]])
    mask = torch.tensor([[[True, False], [True, False]]])
    # Distances 5 and 3; absolute errors 3+4+0+1+2+2 over 6 coordinates; squares 25+9 over 6.
    for norm, expected in {"l2": 4.0, "l1": 2.0, "mse": 34 / 6}.items():
        loss = ops.masked_consistency_loss(joints, targets, mask, norm=norm, backend=backend)
        assert loss.item() == pytest.approx(expected, rel=1e-6)  # one float32 rounding
    # A ground path: the height is free, so the second joint of frame 0 is sqrt(81 + 81) away.
    ground = torch.zeros(1, 2, 2, 3, dtype=torch.bool)
    ground[0, 0, 1, [0, 2]] = True
    loss = ops.masked_consistency_loss(joints, targets, ground, backend=backend)
    assert loss.item() == pytest.approx(162**0.5, rel=1e-6)


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("backend", ["native", "reference"])
def test_reached_targets_and_empty_masks_give_exactly_zero(backend, norm, isa):
    joints = torch.ones(2, 3, 4, 3, requires_grad=True)
    mask = torch.zeros(2, 3, 4, dtype=torch.bool)
    mask[0] = True  # reached in the first clip, nothing controlled in the second
    loss = ops.masked_consistency_loss(
        joints, joints.detach(), mask, norm=norm, reduction="clip", backend=backend
    )
    loss.sum().backward()
    assert torch.equal(loss, torch.zeros(2))
    assert torch.equal(joints.grad, torch.zeros_like(joints))


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_nan_position_under_the_mask_is_reported_and_stays_in_its_joint(backend, isa):
    joints = torch.zeros(1, 2, 3, 3)
    joints[0, 0, 1, 0] = torch.nan
    joints.requires_grad_()
    mask = torch.ones(1, 2, 3, dtype=torch.bool)
    for norm in NORMS:
        loss = ops.masked_consistency_loss(joints, torch.ones_like(joints), mask, norm=norm, backend=backend)
        (gradient,) = torch.autograd.grad(loss, joints)
        assert loss.isnan()
        others = torch.ones(1, 2, 3, dtype=torch.bool)
        others[0, 0, 1] = False
        assert gradient[others].isfinite().all()


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_gradcheck(norm, reduction, isa):
    joints, targets, mask = Case("small", batch=2, frames=3, joints=2, density=0.6).arguments(torch.float64)
    torch.autograd.gradcheck(
        lambda j, t: ops.masked_consistency_loss(
            j, t, mask, norm=norm, reduction=reduction, backend="native"
        ),
        (joints.requires_grad_(), targets.nan_to_num(0).requires_grad_()),
    )


def test_every_instruction_set_gives_the_same_bits():
    joints, targets, mask = Case("long", frames=196).arguments(torch.float32)
    results = []
    for isa in ops.available_isas():
        with ops.use_isa(isa):
            results.append(
                value_and_gradients(
                    lambda j, t: ops.masked_consistency_loss(j, t, mask, backend="native"),
                    joints, targets, torch.tensor(1.0),
                )
            )  # fmt: skip
    for result in results[1:]:
        for mine, first in zip(result, results[0], strict=True):
            assert torch.equal(mine, first)


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_impossible_arguments_are_refused(backend):
    joints, targets, mask = Case("small").arguments(torch.float32)
    with pytest.raises(TypeError, match=r"`mask` must be boolean, got torch.float32"):
        ops.masked_consistency_loss(joints, targets, mask.float(), backend=backend)
    with pytest.raises(TypeError, match="`joints` and `targets` must share one floating-point dtype"):
        ops.masked_consistency_loss(joints, targets.double(), mask, backend=backend)
    with pytest.raises(ValueError, match=r"must both have shape \(B, T, J, 3\)"):
        ops.masked_consistency_loss(joints[0], targets[0], mask, backend=backend)
    with pytest.raises(ValueError, match=r"`mask` must have shape \(3, 11, 22\) or \(3, 11, 22, 3\)"):
        ops.masked_consistency_loss(joints, targets, mask[:, 1:], backend=backend)
    with pytest.raises(ValueError, match=r"`norm` must be one of"):
        ops.masked_consistency_loss(joints, targets, mask, norm="l3", backend=backend)
    with pytest.raises(ValueError, match=r"`reduction` must be one of"):
        ops.masked_consistency_loss(joints, targets, mask, reduction="none", backend=backend)
