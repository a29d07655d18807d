"""The kernels as ``torch.library`` operators (``torch.ops.controlmm.*``): what ``torch.compile`` and export
trace.

Eager calls take ``autograd.Function`` instead, which costs about half as much around a small kernel.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from controlmm.ops.consistency import Norm, Reduction, consistency_backward, consistency_forward
from controlmm.ops.guidance import guidance_native
from controlmm.ops.gumbel import codebook_gradient, gumbel_backward, gumbel_forward
from controlmm.ops.kinematics import recover_joints_backward, recover_joints_forward
from controlmm.ops.obstacle_loss import obstacle_loss_backward, obstacle_loss_forward

_LIB = torch.library.Library("controlmm", "DEF")

_OBSTACLES = (
    "Tensor kinds, Tensor parameters, Tensor heights, Tensor radii, Tensor is_active, Tensor lengths, "
    "float margin, bool is_mean"
)
_SCHEMAS = (
    "recover_joints(Tensor features, int joints) -> Tensor",
    "recover_joints_backward(Tensor features, Tensor grad_joints) -> Tensor",
    "masked_consistency_loss(Tensor joints, Tensor targets, Tensor mask, str norm, str reduction)"
    " -> (Tensor, Tensor)",
    "masked_consistency_loss_backward(Tensor joints, Tensor targets, Tensor mask, str norm, "
    "Tensor grad_loss, Tensor counts) -> Tensor",
    f"obstacle_loss(Tensor joints, {_OBSTACLES}) -> Tensor",
    f"obstacle_loss_backward(Tensor joints, {_OBSTACLES}, Tensor grad_loss) -> Tensor",
    "gumbel_straight_through(Tensor logits, Tensor codebook, float temperature, int seed, int first_clip, "
    "bool hard) -> (Tensor, Tensor, Tensor)",
    "gumbel_backward(Tensor grad_embeddings, Tensor codebook, Tensor probabilities, float temperature)"
    " -> Tensor",
    "guidance_value_and_grad(Tensor decoded, Tensor mean, Tensor std, Tensor targets, Tensor mask, str norm, "
    f"{_OBSTACLES}, float obstacle_weight) -> (Tensor, Tensor)",
)
for _schema in _SCHEMAS:
    _LIB.define(_schema)

_ops = torch.ops.controlmm


# Kinematics


def _recover_fake(features: Tensor, joints: int) -> Tensor:
    return features.new_empty((features.shape[0], features.shape[1], joints, 3))


def _recover_save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:  # noqa: ARG001 (called by name)
    ctx.save_for_backward(inputs[0])


def _recover_gradient(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
    (features,) = ctx.saved_tensors
    return _ops.recover_joints_backward(features, grad), None


# Consistency


def _consistency_fake(joints: Tensor, *rest: Any) -> tuple[Tensor, Tensor]:
    shape = (joints.shape[0],) if rest[-1] == "clip" else ()
    return joints.new_empty(shape), joints.new_empty(shape, dtype=torch.float64)


def _consistency_backward_fake(joints: Tensor, *_: Any) -> Tensor:
    return joints.new_empty(joints.shape)


def _consistency_save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    ctx.save_for_backward(*inputs[:3], output[1])
    ctx.norm = inputs[3]
    ctx.mark_non_differentiable(output[1])


def _consistency_gradient(
    ctx: Any, grad: Tensor, _: Tensor
) -> tuple[Tensor | None, Tensor | None, None, None, None]:
    joints, targets, mask, counts = ctx.saved_tensors
    gradient = _ops.masked_consistency_loss_backward(joints, targets, mask, ctx.norm, grad, counts)
    wants_joints, wants_targets = ctx.needs_input_grad[:2]
    return gradient if wants_joints else None, -gradient if wants_targets else None, None, None, None


# Obstacles


def _obstacle_cpu(joints: Tensor, *rest: Any) -> Tensor:
    return obstacle_loss_forward(joints, rest[:6], *rest[6:])


def _obstacle_backward_cpu(joints: Tensor, *rest: Any) -> Tensor:
    return obstacle_loss_backward(joints, rest[:6], *rest[6:])


def _obstacle_fake(joints: Tensor, *_: Any) -> Tensor:
    return joints.new_empty(joints.shape[0])


def _obstacle_backward_fake(joints: Tensor, *_: Any) -> Tensor:
    return torch.empty_like(joints)


def _obstacle_save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:  # noqa: ARG001 (called by name)
    ctx.save_for_backward(*inputs[:7])
    ctx.margin, ctx.is_mean = inputs[7:9]


def _obstacle_gradient(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    gradient = _ops.obstacle_loss_backward(*ctx.saved_tensors, ctx.margin, ctx.is_mean, grad)
    return gradient, *(None,) * 8


# Gumbel


def _gumbel_cpu(
    logits: Tensor, codebook: Tensor, temperature: float, seed: int, first_clip: int, hard: bool
) -> tuple[Tensor, Tensor, Tensor]:
    return gumbel_forward(
        logits, codebook, temperature, seed % 2**64, first_clip, hard, keep_probabilities=True
    )


def _gumbel_fake(logits: Tensor, codebook: Tensor, *_: Any) -> tuple[Tensor, Tensor, Tensor]:
    batch, tokens, codes = logits.shape
    ids = logits.new_empty((batch, tokens), dtype=torch.int64)
    embeddings = logits.new_empty((batch, tokens, codebook.shape[1]))
    return embeddings, ids, logits.new_empty((batch, tokens, codes))


def _gumbel_backward_fake(_: Tensor, __: Tensor, probabilities: Tensor, ___: float) -> Tensor:
    return probabilities.new_empty(probabilities.shape)


def _gumbel_save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor, Tensor]) -> None:
    ctx.save_for_backward(inputs[1], output[1], output[2])
    ctx.temperature, ctx.hard = inputs[2], inputs[5]
    ctx.mark_non_differentiable(output[1], output[2])


def _gumbel_gradient(ctx: Any, grad: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
    codebook, ids, probabilities = ctx.saved_tensors
    grad_logits = grad_codebook = None
    if ctx.needs_input_grad[0]:
        grad_logits = _ops.gumbel_backward(grad, codebook, probabilities, ctx.temperature)
    if ctx.needs_input_grad[1]:
        grad_codebook = codebook_gradient(grad, ids, probabilities, ctx.hard)
    return grad_logits, grad_codebook, None, None, None, None


# Guidance gives values only: there is nothing to differentiate.


def _guidance_cpu(decoded: Tensor, *rest: Any) -> tuple[Tensor, Tensor]:
    mean, std, targets, mask, norm = rest[:5]
    margin, is_mean, obstacle_weight = rest[11:]
    gradient = torch.zeros_like(decoded)
    loss = guidance_native(
        decoded, mean, std, targets, mask, norm, rest[5:11], margin, is_mean, obstacle_weight, gradient
    )
    return loss, gradient


def _guidance_fake(decoded: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    return decoded.new_empty(decoded.shape[0]), torch.empty_like(decoded)


def _consistency_cpu(
    joints: Tensor, targets: Tensor, mask: Tensor, norm: Norm, reduction: Reduction
) -> tuple[Tensor, Tensor]:
    return consistency_forward(joints, targets, mask, norm, reduction)


_KERNELS: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "recover_joints": (recover_joints_forward, _recover_fake),
    "recover_joints_backward": (recover_joints_backward, lambda features, _: torch.empty_like(features)),
    "masked_consistency_loss": (_consistency_cpu, _consistency_fake),
    "masked_consistency_loss_backward": (consistency_backward, _consistency_backward_fake),
    "obstacle_loss": (_obstacle_cpu, _obstacle_fake),
    "obstacle_loss_backward": (_obstacle_backward_cpu, _obstacle_backward_fake),
    "gumbel_straight_through": (_gumbel_cpu, _gumbel_fake),
    "gumbel_backward": (gumbel_backward, _gumbel_backward_fake),
    "guidance_value_and_grad": (_guidance_cpu, _guidance_fake),
}
_GRADIENTS: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "recover_joints": (_recover_gradient, _recover_save),
    "masked_consistency_loss": (_consistency_gradient, _consistency_save),
    "obstacle_loss": (_obstacle_gradient, _obstacle_save),
    "gumbel_straight_through": (_gumbel_gradient, _gumbel_save),
}
for _name, (_kernel, _fake) in _KERNELS.items():
    _LIB.impl(_name, _kernel, "CPU")
    torch.library.register_fake(f"controlmm::{_name}", _fake, lib=_LIB)
for _name, (_gradient, _save) in _GRADIENTS.items():
    torch.library.register_autograd(f"controlmm::{_name}", _gradient, setup_context=_save, lib=_LIB)
