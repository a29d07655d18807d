"""Distance of controlled joints to their targets."""

from __future__ import annotations

from typing import Any, Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.ops.backend import Backend, core, refuse_second_derivative, runs_native
from controlmm.ops.reference import masked_consistency_loss_reference

Norm = Literal["l2", "l1", "mse"]
Reduction = Literal["batch", "clip"]

NORM_CODES: dict[Norm, int] = {"l2": 0, "l1": 1, "mse": 2}


def masked_consistency_loss(
    joints: Float[Tensor, "B T J 3"],
    targets: Float[Tensor, "B T J 3"],
    mask: Bool[Tensor, "B T J"] | Bool[Tensor, "B T J 3"],
    *,
    norm: Norm = "l2",
    reduction: Reduction = "batch",
    backend: Backend | None = None,
) -> Float[Tensor, ""] | Float[Tensor, "B"]:
    """How far controlled joints are from their targets, in metres (square metres for "mse"). Differentiable.

    Entries outside the mask are never used, not even if they are NaN. An empty mask gives exactly 0, and the
    gradient of "l2" at distance 0 is 0. Source: ControlMM, equation 4.

    Args:
        joints: Global joint positions in metres.
        targets: Wanted positions in the same frame.
        mask: True where a joint is controlled, or for each coordinate (a ground path controls x and z only).
        norm: "l2" averages the Euclidean distance over the masked coordinates of each controlled joint;
            "l1" and "mse" average the absolute and the squared error over masked coordinates.
        reduction: "batch" pools all entries into one scalar; "clip" gives (B,), one value a clip.
        backend: "native", "reference" or "auto"; ``None`` asks the context and the environment.

    Raises:
        TypeError: If ``mask`` is not boolean or ``joints`` not floating point.
        ValueError: If shapes differ, or ``norm``, ``reduction`` or ``backend`` is unknown or cannot run.
    """
    check_consistency_arguments(joints, targets, mask, norm)
    if reduction not in get_args(Reduction):
        raise ValueError(f"`reduction` must be one of {get_args(Reduction)}, got {reduction!r}.")
    per_coordinate = mask if mask.ndim == 4 else mask[..., None].expand(*mask.shape, 3)
    if not runs_native(backend, joints, targets) or mask.device.type != "cpu":
        return masked_consistency_loss_reference(joints, targets, per_coordinate, norm, reduction)
    return _consistency_native(joints, targets, per_coordinate, norm, reduction)


def check_consistency_arguments(joints: Tensor, targets: Tensor, mask: Tensor, norm: str) -> None:
    """Check what every consistency operator takes; ``joints`` must be (B, T, J, 3).

    Raises:
        TypeError: If ``mask`` is not boolean or ``joints`` not floating point.
        ValueError: If shapes differ or ``norm`` is unknown.
    """
    if norm not in NORM_CODES:
        raise ValueError(f"`norm` must be one of {tuple(NORM_CODES)}, got {norm!r}.")
    if not joints.is_floating_point() or targets.dtype != joints.dtype:
        raise TypeError(
            "`joints` and `targets` must share one floating-point dtype, "
            f"got {joints.dtype} and {targets.dtype}."
        )
    if joints.ndim != 4 or joints.shape[-1] != 3 or targets.shape != joints.shape:
        raise ValueError(
            "`joints` and `targets` must both have shape (B, T, J, 3), "
            f"got {tuple(joints.shape)} and {tuple(targets.shape)}."
        )
    if mask.dtype != torch.bool:
        raise TypeError(f"`mask` must be boolean, got {mask.dtype}. Use `mask > 0` or `.bool()`.")
    if mask.shape not in (joints.shape, joints.shape[:3]):
        raise ValueError(
            f"`mask` must have shape {tuple(joints.shape[:3])} or {tuple(joints.shape)}, "
            f"got {tuple(mask.shape)}."
        )


def _consistency_native(
    joints: Tensor, targets: Tensor, mask: Tensor, norm: Norm, reduction: Reduction
) -> Tensor:
    if torch.compiler.is_compiling():
        loss: Tensor = torch.ops.controlmm.masked_consistency_loss(joints, targets, mask, norm, reduction)[0]
        return loss
    needs_gradient = torch.is_grad_enabled() and (joints.requires_grad or targets.requires_grad)
    if needs_gradient:
        result: Tensor = _MaskedConsistency.apply(joints, targets, mask, norm, reduction)
        return result
    return consistency_forward(joints, targets, mask, norm, reduction)[0]


def consistency_forward(
    joints: Tensor, targets: Tensor, mask: Tensor, norm: Norm, reduction: Reduction
) -> tuple[Tensor, Tensor]:
    """The kernel alone: the loss, and the numbers of masked entries it was divided by (float64)."""
    shape = (joints.shape[0],) if reduction == "clip" else ()
    loss = joints.new_empty(shape)
    counts = joints.new_empty(shape, dtype=torch.float64)
    core().masked_consistency_loss(
        joints, targets, mask, NORM_CODES[norm], loss, counts, torch.get_num_threads()
    )
    return loss, counts


def consistency_backward(
    joints: Tensor, targets: Tensor, mask: Tensor, norm: Norm, grad_loss: Tensor, counts: Tensor
) -> Float[Tensor, "B T J 3"]:
    """The gradient kernel alone, with respect to ``joints``; that of ``targets`` is its negative."""
    grad = joints.new_empty(joints.shape)
    core().masked_consistency_loss_backward(
        joints, targets, mask, NORM_CODES[norm], grad_loss, counts, grad, torch.get_num_threads()
    )
    return grad


class _MaskedConsistency(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, joints: Tensor, targets: Tensor, mask: Tensor, norm: Norm, reduction: Reduction
    ) -> Tensor:
        loss, counts = consistency_forward(joints, targets, mask, norm, reduction)
        ctx.save_for_backward(joints, targets, mask, counts)
        ctx.norm = norm
        return loss

    @staticmethod
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor | None, Tensor | None, None, None, None]:
        refuse_second_derivative("masked_consistency_loss")
        joints, targets, mask, counts = ctx.saved_tensors
        grad = consistency_backward(joints, targets, mask, ctx.norm, grad_loss, counts)
        wants_joints, wants_targets = ctx.needs_input_grad[:2]
        return grad if wants_joints else None, -grad if wants_targets else None, None, None, None
