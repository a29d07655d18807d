"""How far single precision is from the exact joints, and that it is nearer than eager torch."""

import pytest
import torch
from benchmarks.eager import lean_joints, quaternion_joints

from controlmm import ops

pytestmark = pytest.mark.skipif(not ops.available_isas(), reason="the C++ extension is not built")

FRAMES = 196
REAL_BOUND = 3e-7  # metres; single precision itself is spaced by 2.4e-7 where this walk ends, 2 m away
STRESS_BOUND = 5e-7  # metres; a walk that turns and goes several metres


def walk(*, turn, speed, seed):
    """Features of a walk whose yaw and speed wander about ``turn`` radians and ``speed`` metres a frame."""
    noise = torch.randn(32, FRAMES, 263, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    features = 0.3 * noise
    features[..., 0] = turn * (1 + 0.5 * noise[..., 0])
    features[..., 1] = 0.1 * speed * noise[..., 1]
    features[..., 2] = speed * (1 + 0.3 * noise[..., 2])
    features[..., 3] = 0.95 + 0.02 * noise[..., 3]
    return features.float()


def error(joints, features):
    exact = ops.recover_joints(features.double(), backend="reference")
    return (joints.double() - exact).abs().max().item()


WALKS = {
    "gentle": ({"turn": 0.01, "speed": 0.01}, REAL_BOUND),
    "stress": ({"turn": 0.3, "speed": 0.05}, STRESS_BOUND),
}


@pytest.mark.parametrize(("kind", "bound"), WALKS.values(), ids=WALKS)
def test_error_over_a_full_clip(kind, bound, isa):
    features = walk(**kind, seed=1)
    mine = error(ops.recover_joints(features, backend="native"), features)
    assert mine <= bound
    assert mine < error(quaternion_joints(features), features)
    assert mine <= error(lean_joints(features), features)


def test_gradient_is_nearer_than_that_of_eager_torch(isa):
    features = walk(turn=0.3, speed=0.05, seed=2)
    cotangent = torch.randn(32, FRAMES, 22, 3, generator=torch.Generator().manual_seed(5))

    def gradient(function, dtype):
        leaf = features.to(dtype).requires_grad_()
        return torch.autograd.grad(function(leaf), leaf, cotangent.to(dtype))[0].double()

    exact = gradient(lean_joints, torch.float64)
    mine = gradient(lambda x: ops.recover_joints(x, backend="native"), torch.float32)
    eager = gradient(quaternion_joints, torch.float32)
    assert (mine - exact).abs().max() < (eager - exact).abs().max()
    assert (mine - exact).abs().max() <= 3e-7 * exact.abs().max()  # single precision, relative to the largest
