"""compat.recover_from_ric: what public code gets when it swaps one import line."""

import pytest
import torch
from benchmarks.eager import quaternion_joints

from controlmm import ops
from controlmm.ops.compat import recover_from_ric

ROUNDING = {"rtol": 1e-12, "atol": 1e-12}  # float64, sums in another order


def features(*leading, dim=263):
    values = torch.randn(*leading, dim, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    values[..., :3] *= 0.05
    return values


@pytest.mark.parametrize("leading", [(9,), (2, 9), (2, 1, 9), (2, 3, 1, 9)], ids=str)
@pytest.mark.parametrize(("joints", "dim"), [(22, 263), (21, 251)], ids=["humanml3d", "kit"])
def test_any_leading_dimensions_give_what_the_public_form_gives(leading, joints, dim):
    data = features(*leading, dim=dim)
    actual = recover_from_ric(data, joints)
    assert actual.shape == (*leading, joints, 3)
    torch.testing.assert_close(actual, quaternion_joints(data, joints), **ROUNDING)


def test_the_gradient_is_that_of_the_public_form():
    data = features(2, 1, 9)
    weights = torch.randn(2, 1, 9, 22, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    gradients = []
    for function in (recover_from_ric, quaternion_joints):
        leaf = data.clone().requires_grad_()
        gradients.append(torch.autograd.grad(function(leaf, 22), leaf, weights)[0])
    torch.testing.assert_close(*gradients, rtol=1e-11, atol=1e-11)


def test_the_permuted_output_of_a_sampler_needs_no_copy():
    sample = features(2, 9).permute(0, 2, 1).contiguous()[:, :, None]  # (B, D, 1, T), as MDM samples
    torch.testing.assert_close(
        recover_from_ric(sample.permute(0, 2, 3, 1), 22)[:, 0], quaternion_joints(features(2, 9)), **ROUNDING
    )


@pytest.mark.skipif(not ops.available_isas(), reason="the C++ extension is not built")
def test_tensors_of_another_device_take_the_reference_and_stay_there():
    data = features(2, 9).to(
        "meta"
    )  # stands for CUDA: all that is asked of a tensor is that it is on the CPU
    assert recover_from_ric(data, 22).device.type == "meta"
    with pytest.raises(ValueError, match="a tensor is on meta, the kernels run on the CPU"):
        ops.recover_joints(data, backend="native")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_tensors_are_handled():
    data = features(2, 9).cuda().requires_grad_()
    result = recover_from_ric(data, 22)
    result.sum().backward()
    torch.testing.assert_close(result.cpu(), quaternion_joints(features(2, 9)), **ROUNDING)
    assert data.grad.is_cuda
