"""Nothing a caller hands over may crash the process, and every refusal says what was wrong."""

import multiprocessing
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from controlmm import ops

pytestmark = pytest.mark.skipif(not ops.available_isas(), reason="the C++ extension is not built")

if ops.available_isas():
    from controlmm import _core

DTYPES = [
    torch.float32,
    torch.float64,
    torch.float16,
    torch.bfloat16,
    torch.int64,
    torch.bool,
    torch.complex64,
]
VALUES = [0.0, 1.0, -3.5, float("nan"), float("inf"), -float("inf"), 1e30, 5e-324]


@st.composite
def tensors(draw, max_dims=5):
    shape = draw(st.lists(st.integers(0, 7), max_size=max_dims))
    if draw(st.booleans()):
        shape = [*shape[:2], draw(st.sampled_from([4, 67, 70, 263, 3]))]
    tensor = torch.full(shape, draw(st.sampled_from(VALUES)), dtype=torch.float64)
    tensor = (
        tensor.nan_to_num(0, 0, 0).to(torch.int64) if draw(st.booleans()) and draw(st.booleans()) else tensor
    )
    tensor = tensor.to(draw(st.sampled_from(DTYPES)))
    change = draw(st.sampled_from(["none", "transpose", "expand", "step", "meta", "sparse"]))
    if change == "transpose" and tensor.ndim >= 2:
        return tensor.transpose(0, -1)
    if change == "expand" and tensor.ndim >= 1:
        return tensor[:1].expand(tensor.shape) if tensor.shape[0] else tensor
    if change == "step" and tensor.ndim >= 1:
        return tensor[..., ::2]
    if change == "meta":
        return tensor.to("meta")
    if change == "sparse" and tensor.dtype == torch.float32:
        return tensor.to_sparse()
    return tensor


REFUSALS = (ValueError, TypeError, RuntimeError, NotImplementedError, IndexError)


@settings(max_examples=150, deadline=None)
@given(
    a=tensors(),
    b=tensors(),
    c=tensors(),
    joints=st.integers(-1, 25),
    parents=st.lists(st.integers(-1, 6), max_size=7),
    steps=st.integers(-1, 4),
)
def test_public_operators_answer_or_refuse_anything(a, b, c, joints, parents, steps):
    foot = {"parents": parents, "feet": (joints,), "enough": 1e-3, "steps": steps}
    calls = [
        lambda: ops.project_change(a, b, c, parents=parents),
        lambda: ops.smooth_bones(a, b, a.bool(), c, toes=(0,), **foot),
        lambda: ops.frame_bones(a, b, a.bool(), c, **foot),
        lambda: ops.swing_rotations(a, b, b, c, chains=[parents, range(joints)]),
        lambda: ops.recover_joints(a, joints=joints),
        lambda: ops.masked_consistency_loss(a, b, c),
        lambda: ops.obstacle_loss(a, [ops.Sphere((0, 0, 0), 1.0)], lengths=b),
        lambda: ops.gumbel_straight_through(a, b, seed=0),
        lambda: ops.guidance_value_and_grad(a, b, c, mean=a, std=b),
        lambda: ops.winograd_weights(a),
        lambda: ops.winograd_parts(a, ops.WinogradTiles(b, c, joints)),
        lambda: ops.winograd_parts(a, ops.WinogradTiles.of(parents, steps)),
        lambda: ops.winograd_frames(a, ops.WinogradTiles.of((5, 2), 1), b),
    ]
    for call in calls:
        try:
            call()
        except REFUSALS as error:
            assert str(error)  # noqa: PT017 (most calls succeed)


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_raw_kernels_answer_or_refuse_anything(data):
    name = data.draw(st.sampled_from([n for n in dir(_core) if not n.startswith("_") and n not in META]))
    arguments = [data.draw(tensors()) for _ in range(ARGUMENTS[name][0])]
    try:
        getattr(_core, name)(*ARGUMENTS[name][1](arguments))
    except REFUSALS as error:
        assert str(error)  # noqa: PT017 (most calls succeed)


META = {"version", "compiler", "bindings", "available_isas", "active_isa", "set_isa"}
# Number of tensors, and how they are interleaved with plain numbers.
ARGUMENTS = {
    "recover_joints": (2, lambda t: (*t, 1)),
    "recover_joints_backward": (3, lambda t: (*t, 1)),
    "masked_consistency_loss": (5, lambda t: (*t[:3], 0, *t[3:], 1)),
    "masked_consistency_loss_backward": (6, lambda t: (*t[:3], 0, *t[3:], 1)),
    "obstacle_loss": (8, lambda t: (*t[:7], 0.1, True, t[7], 1)),
    "obstacle_loss_backward": (9, lambda t: (*t[:7], 0.1, True, *t[7:], 1)),
    "guidance_value_and_grad": (13, lambda t: (*t[:5], 0, *t[5:11], 0.1, True, 1.0, *t[11:], 1)),
    "control_value_and_grad": (7, lambda t: (*t[:5], 0, *t[5:], 1)),
    "gumbel_noise": (1, lambda t: (1, 2, *t, 1)),
    "gumbel_straight_through": (5, lambda t: (*t[:2], 1.0, 3, 4, *t[2:], 1)),
    "softmax_backward": (2, lambda t: (t[0], 1.0, t[1], 1)),
    "project_change": (4, lambda t: (*t[:3], 10.0, 100.0, 1e4, t[3])),
    "smooth_bones": (8, lambda t: (*t[:7], 10.0, 1e3, 100.0, 1e4, 1e5, 3e3, 1e3, 1e-3, 2, t[7])),
    "swing_rotations": (6, lambda t: t),
    "winograd_parts": (3, lambda t: t),
    "winograd_frames": (4, lambda t: (*t[:3], True, t[3])),
    "frame_bones": (6, lambda t: (*t[:5], 10.0, 1e3, 1e4, 1e-9, 1e-3, 0.05, 2, t[5])),
}


@pytest.mark.parametrize("wrong", [None, 3, "text", [1.0], np.zeros(3).tolist()])
def test_what_is_no_tensor_is_refused(wrong):
    with pytest.raises(TypeError):
        _core.recover_joints(wrong, torch.zeros(1, 1, 22, 3), 1)
    with pytest.raises(TypeError, match="`features` must be a floating-point tensor"):
        ops.recover_joints(wrong)


def test_numpy_arrays_reach_the_kernels_and_read_only_outputs_are_refused():
    features, joints = np.zeros((1, 2, 67), np.float32), np.ones((1, 2, 22, 3), np.float32)
    _core.recover_joints(features, joints, 1)
    assert not joints.any()
    features.setflags(write=False)
    _core.recover_joints(features, joints, 1)  # reading is fine
    joints.setflags(write=False)
    with pytest.raises(ValueError, match="`joints` must be writable"):
        _core.recover_joints(features, joints, 1)


def test_negative_strides_of_numpy_are_followed():
    features = np.random.default_rng(0).normal(size=(1, 9, 67))
    joints = np.empty((1, 9, 22, 3))
    _core.recover_joints(features[:, ::-1], joints, 1)
    expected = ops.recover_joints(torch.from_numpy(features[:, ::-1].copy()), backend="reference")
    np.testing.assert_allclose(joints, expected.numpy(), rtol=1e-12, atol=1e-12)


def test_misaligned_memory_is_refused():
    raw = torch.zeros(4 * 2 * 67 + 1, dtype=torch.uint8)
    features = torch.from_numpy(raw.numpy()[1:].view(np.float32).reshape(1, 2, 67))
    with pytest.raises(ValueError, match="multiple of its element size"):
        ops.recover_joints(features, backend="native")


def test_half_precision_takes_the_reference_and_native_says_why():
    features = torch.zeros(1, 2, 263, dtype=torch.bfloat16)
    assert ops.recover_joints(features).dtype == torch.bfloat16
    with pytest.raises(ValueError, match=r"cannot run: tensors must be all float32 or all float64"):
        ops.recover_joints(features, backend="native")


def test_backend_choice_argument_before_context_before_environment(monkeypatch):
    features = torch.zeros(1, 2, 263, dtype=torch.bfloat16)  # native refuses, so the choice shows
    monkeypatch.setenv("CONTROLMM_BACKEND", "native")
    with pytest.raises(ValueError, match="cannot run"):
        ops.recover_joints(features)
    with ops.use_backend("reference"):
        ops.recover_joints(features)
        with pytest.raises(ValueError, match="cannot run"):
            ops.recover_joints(features, backend="native")
    monkeypatch.setenv("CONTROLMM_BACKEND", "fast")
    with pytest.raises(ValueError, match="`backend` must be one of"):
        ops.recover_joints(features)


@pytest.mark.parametrize("isa", [*ops.available_isas()[:1], "neon9"])
def test_environment_forces_the_instruction_set(isa):
    run = subprocess.run(
        [sys.executable, "-c", "from controlmm import ops; print(ops.build_info().isa)"],
        env={**os.environ, "CONTROLMM_ISA": isa},
        capture_output=True,
        text=True,
        check=False,
    )
    if isa in ops.available_isas():
        assert run.stdout.split() == [isa]
    else:
        assert "`CONTROLMM_ISA` must be an instruction set this machine runs" in run.stderr


def _joints_in_child(features, joints):
    _core.recover_joints(features, joints, 2)


def test_kernels_run_in_several_threads_after_a_fork():
    # Tensors are made before the fork: torch's own thread pool is what does not survive one.
    features, joints = torch.zeros(64, 196, 263), torch.ones(64, 196, 22, 3)
    _core.recover_joints(features, joints, 2)
    child = multiprocessing.get_context("fork").Process(target=_joints_in_child, args=(features, joints))
    child.start()
    child.join(timeout=30)
    assert child.exitcode == 0
