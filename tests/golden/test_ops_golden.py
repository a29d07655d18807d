"""Kinematics against joints and gradients computed by the public functions (shared/reference/golden)."""

from pathlib import Path

import numpy as np
import pytest
import torch

from controlmm import ops

GOLDEN = Path(__file__).resolve().parents[3] / "shared" / "reference" / "golden"
pytestmark = pytest.mark.skipif(not GOLDEN.is_dir(), reason="golden arrays are not beside this checkout")

DOUBLE_ROUNDING = 1e-12  # sums of 49 frames in another order
# The golden joints of real clips are float32 results of another algorithm, itself off by this much.
FLOAT_ROUNDING = 2e-6
BACKENDS = ["reference", *(["native"] if ops.available_isas() else [])]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("prefix", "joints"), [("t2m", 22), ("kit", 21)])
def test_double_precision_values_and_gradients(prefix, joints, backend):
    golden = {
        key: torch.from_numpy(value) for key, value in np.load(GOLDEN / "recover_random_f64.npz").items()
    }
    features = golden[f"{prefix}_features"].requires_grad_()
    actual = ops.recover_joints(features, joints=joints, backend=backend)
    (gradient,) = torch.autograd.grad(actual, features, golden[f"{prefix}_cotangent"])
    torch.testing.assert_close(actual, golden[f"{prefix}_joints"], rtol=DOUBLE_ROUNDING, atol=DOUBLE_ROUNDING)
    torch.testing.assert_close(gradient, golden[f"{prefix}_grad"], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("clip", "path"),
    [("012314", "humanml3d/new_joint_vecs_012314.npy"), ("000612", "momask/000612.npy")],
)
def test_real_clips_in_single_precision(clip, path, backend):
    features = torch.from_numpy(np.load(GOLDEN / path)).float()
    expected = torch.from_numpy(np.load(GOLDEN / "recover_real_f32.npz")[f"joints_{clip}"])
    actual = ops.recover_joints(features, backend=backend)
    torch.testing.assert_close(actual, expected.reshape(actual.shape), rtol=0, atol=FLOAT_ROUNDING)


@pytest.mark.skipif(not ops.available_isas(), reason="the C++ extension is not built")
@pytest.mark.parametrize("path", ["humanml3d/new_joint_vecs_012314.npy", "momask/000612.npy"])
def test_native_single_precision_stays_within_a_third_of_a_micrometre_on_real_motion(path):
    features = torch.from_numpy(np.load(GOLDEN / path)).float()
    exact = ops.recover_joints(features.double(), backend="reference")
    error = (ops.recover_joints(features, backend="native").double() - exact).abs().max().item()
    assert error <= 3e-7  # metres, over up to 199 frames
