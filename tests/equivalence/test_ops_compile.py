"""The operators under torch.compile, opcheck, torch.func and double backward."""

import importlib

import pytest
import torch

from controlmm import ops
from controlmm.ops.clearance import resolve_clearance
from controlmm.ops.obstacle_loss import native_arguments

pytestmark = pytest.mark.skipif(not ops.available_isas(), reason="the C++ extension is not built")

SCENE = [ops.Sphere((0.1, 0.2, 0.3), 1.2), ops.Box((0, 0, 0), (0.5, 0.6, 0.7))]
PACKED = ops.pack_obstacles(SCENE, dtype=torch.float64)


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 0.3


FEATURES, JOINTS, TARGETS = random(2, 7, 263), random(2, 7, 22, 3), random(2, 7, 22, 3, seed=1)
MASK = random(2, 7, 22, 3, seed=2) > 0
LOGITS, CODEBOOK = random(2, 4, 32), random(32, 6)
MEAN, STD = random(263), random(263).abs()

# What a user would compile: name -> (function, differentiable arguments).
FUNCTIONS = {
    "recover_joints": (lambda x: ops.recover_joints(x).square().sum(), [FEATURES]),
    "masked_consistency_loss": (lambda x, y: ops.masked_consistency_loss(x, y, MASK), [JOINTS, TARGETS]),
    "obstacle_loss": (lambda x: ops.obstacle_loss(x, PACKED, margin=0.1).sum(), [JOINTS]),
    "gumbel_hard": (
        lambda x, c: ops.gumbel_straight_through(x, c, seed=2**63 + 5)[0].square().sum(),
        [LOGITS, CODEBOOK],
    ),
    "gumbel_soft": (
        lambda x, c: ops.gumbel_straight_through(x, c, seed=3, hard=False)[0].square().sum(),
        [LOGITS, CODEBOOK],
    ),
}


def value_and_gradients(function, arguments):
    leaves = [argument.detach().requires_grad_() for argument in arguments]
    value = function(*leaves)
    return value.detach(), *torch.autograd.grad(value, leaves)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_compiles_without_graph_breaks_and_gives_the_same(name):
    function, arguments = FUNCTIONS[name]
    torch._dynamo.reset()
    # "aot_eager" traces forward and backward as every backend does, without generating code.
    compiled = torch.compile(function, fullgraph=True, backend="aot_eager")
    for mine, eager in zip(
        value_and_gradients(compiled, arguments), value_and_gradients(function, arguments), strict=True
    ):
        torch.testing.assert_close(mine, eager, rtol=1e-12, atol=1e-12)


def test_guidance_compiles():
    decoded = FEATURES.transpose(1, 2)

    def function(x):
        return ops.guidance_value_and_grad(x, TARGETS, MASK, PACKED, mean=MEAN, std=STD)

    torch._dynamo.reset()
    compiled = torch.compile(function, fullgraph=True, backend="aot_eager")
    for mine, eager in zip(compiled(decoded), function(decoded), strict=True):
        assert torch.equal(mine, eager)


CLEARANCE = native_arguments(
    PACKED,
    resolve_clearance((2, 7, 22), JOINTS, margin=0.1, joint_radius=0.0, joint_indices=None, lengths=None),
)
OPERATORS = {
    "recover_joints": (FEATURES, 22),
    "masked_consistency_loss": (JOINTS, TARGETS, MASK, "l2", "clip"),
    "obstacle_loss": (JOINTS, *CLEARANCE, 0.1, True),
    "gumbel_straight_through": (LOGITS, CODEBOOK, 0.7, 5, 0, True),
    "guidance_value_and_grad": (
        FEATURES.transpose(1, 2), MEAN, STD, TARGETS, MASK, "l1", *CLEARANCE, 0.1, True, 1.0,
    ),
}  # fmt: skip
DIFFERENTIABLE = {
    "recover_joints": 1,
    "masked_consistency_loss": 2,
    "obstacle_loss": 1,
    "gumbel_straight_through": 2,
}


@pytest.mark.parametrize("name", OPERATORS)
def test_opcheck(name):
    importlib.import_module("controlmm.ops.library")  # loaded on demand, as the compiler does
    arguments = [
        a.clone().requires_grad_() if i < DIFFERENTIABLE.get(name, 0) else a
        for i, a in enumerate(OPERATORS[name])
    ]
    torch.library.opcheck(getattr(torch.ops.controlmm, name).default, tuple(arguments))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_double_backward_says_that_it_cannot(name):
    function, arguments = FUNCTIONS[name]
    leaves = [argument.detach().requires_grad_() for argument in arguments]
    with pytest.raises(RuntimeError, match="has no second derivative in its native form"):
        torch.autograd.grad(function(*leaves), leaves, create_graph=True)


def test_vmap_takes_the_reference_and_gives_the_same():
    batched = torch.func.vmap(ops.recover_joints)(FEATURES)
    torch.testing.assert_close(batched, ops.recover_joints(FEATURES), rtol=1e-12, atol=1e-12)
    with pytest.raises(ValueError, match=r"torch.func transforms \(vmap, grad, jvp\) need plain torch"):
        torch.func.vmap(lambda x: ops.recover_joints(x, backend="native"))(FEATURES)


def test_forward_mode_is_refused_by_the_kernels_and_served_by_the_reference():
    def derivative(backend):
        return torch.func.jvp(lambda x: ops.recover_joints(x, backend=backend), (FEATURES,), (FEATURES,))[1]

    torch.testing.assert_close(derivative("auto"), derivative("reference"))
    with pytest.raises(ValueError, match="need plain torch operators"):
        derivative("native")


def test_gradients_survive_inference_tensors_and_no_grad():
    with torch.no_grad():
        assert not ops.recover_joints(FEATURES.clone().requires_grad_()).requires_grad
    with torch.inference_mode():
        assert ops.recover_joints(FEATURES.clone()).shape == (2, 7, 22, 3)
    assert ops.recover_joints(FEATURES.clone().requires_grad_()).requires_grad
    # A gradient for the targets alone is not lost either.
    targets = TARGETS.clone().requires_grad_()
    assert ops.masked_consistency_loss(JOINTS, targets, MASK).requires_grad
