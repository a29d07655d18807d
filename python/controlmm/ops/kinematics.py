"""Features to global joint positions."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.ops.backend import Backend, core, refuse_second_derivative, runs_native
from controlmm.ops.reference import recover_joints_reference


def recover_joints(
    features: Float[Tensor, "*B T D"], *, joints: int = 22, backend: Backend | None = None
) -> Float[Tensor, "*B T J 3"]:
    """Global joint positions in metres, Y up, of de-normalised HumanML3D (or KIT) features. Differentiable.

    Frame 0 has its root at x = z = 0 and faces +Z. Sums along time run in double precision.

    Args:
        features: De-normalised features with D >= 4 + 3 (J - 1); channels past that are not read. Any
            strides.
        joints: 22 for HumanML3D, 21 for KIT (positions are then in millimetres, as its features are).
        backend: "native", "reference" or "auto"; ``None`` asks the context and the environment.

    Raises:
        TypeError: If ``features`` is not a floating-point tensor.
        ValueError: If its shape does not fit ``joints``, or "native" was asked for and cannot run.
    """
    _check_features(features, joints)
    if not runs_native(backend, features):
        return recover_joints_reference(features, joints)
    if features.ndim == 3:
        return _recover_joints_native(features, joints)
    leading = features.shape[:-2]
    flat = features.reshape(leading.numel(), *features.shape[-2:])
    return _recover_joints_native(flat, joints).reshape(*leading, features.shape[-2], joints, 3)


def _check_features(features: Tensor, joints: int) -> None:
    if not isinstance(features, Tensor) or not features.is_floating_point():
        got = features.dtype if isinstance(features, Tensor) else type(features).__name__
        raise TypeError(f"`features` must be a floating-point tensor, got {got}.")
    if joints < 1:
        raise ValueError(f"`joints` must be at least 1, got {joints}.")
    needed = 4 + 3 * (joints - 1)
    if features.ndim < 2 or features.shape[-1] < needed:
        raise ValueError(
            f"`features` must have shape (..., T, D) with D >= {needed} for {joints} joints, "
            f"got {tuple(features.shape)}."
        )


def _recover_joints_native(features: Float[Tensor, "B T D"], joints: int) -> Float[Tensor, "B T J 3"]:
    if torch.compiler.is_compiling():
        traced: Tensor = torch.ops.controlmm.recover_joints(features, joints)
        return traced
    if features.requires_grad and torch.is_grad_enabled():
        result: Tensor = _RecoverJoints.apply(features, joints)
        return result
    return recover_joints_forward(features, joints)


def recover_joints_forward(features: Float[Tensor, "B T D"], joints: int) -> Float[Tensor, "B T J 3"]:
    """The kernel alone, without autograd."""
    out = features.new_empty((features.shape[0], features.shape[1], joints, 3))
    core().recover_joints(features, out, torch.get_num_threads())
    return out


def recover_joints_backward(
    features: Float[Tensor, "B T D"], grad_joints: Float[Tensor, "B T J 3"]
) -> Float[Tensor, "B T D"]:
    """The gradient kernel alone: (d joints / d features)^T ``grad_joints``."""
    grad = torch.empty_like(features)
    core().recover_joints_backward(features, grad_joints, grad, torch.get_num_threads())
    return grad


class _RecoverJoints(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, joints: int) -> Tensor:
        ctx.save_for_backward(features)
        return recover_joints_forward(features, joints)

    @staticmethod
    def backward(ctx: Any, grad_joints: Tensor) -> tuple[Tensor, None]:
        refuse_second_derivative("recover_joints")
        (features,) = ctx.saved_tensors
        return recover_joints_backward(features, grad_joints), None
