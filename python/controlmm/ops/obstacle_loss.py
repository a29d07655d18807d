"""Depth by which joints enter obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor

from controlmm.ops.backend import Backend, core, refuse_second_derivative, requested_backend, runs_native
from controlmm.ops.clearance import Clearance, resolve_clearance
from controlmm.ops.obstacles import Obstacle, PackedObstacles, pack_obstacles
from controlmm.ops.signed_distance import obstacle_loss_reference

ObstacleReduction = Literal["mean", "sum"]


def obstacle_loss(
    joints: Float[Tensor, "B T J 3"],
    obstacles: Sequence[Obstacle] | PackedObstacles,
    *,
    margin: float = 0.0,
    joint_radius: float | Float[Tensor, "J"] = 0.0,
    joint_indices: Sequence[int] | None = None,
    lengths: Int[Tensor, "B"] | None = None,
    reduction: ObstacleReduction = "mean",
    backend: Backend | None = None,
) -> Float[Tensor, "B"]:
    """Depth by which joints enter obstacles, one value in metres for each clip; 0 when nothing touches.

    Each joint, frame and obstacle gives max(0, margin + joint radius - signed distance). Differentiable in
    ``joints``; with the reference also in the obstacles. Source: ControlMM, equation 9, whose -min(SDF, d)
    differs from this by the constant d.

    Args:
        joints: Global joint positions in metres, Y up.
        obstacles: Primitives in the same frame, or the result of ``pack_obstacles``.
        margin: Safe distance in metres: 0.1 keeps joints 10 cm away.
        joint_radius: Each joint is a ball of this radius in metres.
        joint_indices: Joints that count; ``None`` counts all.
        lengths: Frames that count in each clip; ``None`` counts all T. Later frames may hold anything, even
            NaN.
        reduction: "mean" over counted joints, frames and obstacles, or "sum".
        backend: "native", "reference" or "auto"; ``None`` asks the context and the environment.

    Raises:
        TypeError: If ``joints`` is not floating point or an entry is no obstacle.
        ValueError: If a shape or value does not fit, or "native" was asked for and cannot run.
    """
    if not joints.is_floating_point():
        raise TypeError(f"`joints` must be a floating-point tensor, got {joints.dtype}.")
    if joints.ndim != 4 or joints.shape[-1] != 3:
        raise ValueError(f"`joints` must have shape (B, T, J, 3), got {tuple(joints.shape)}.")
    check_obstacle_reduction(reduction)
    batch, frames, count = joints.shape[:3]
    packed = packed_for(obstacles, batch, frames, joints)
    clearance = resolve_clearance(
        (batch, frames, count), joints,
        margin=margin, joint_radius=joint_radius, joint_indices=joint_indices, lengths=lengths,
    )  # fmt: skip
    if not obstacles_run_native(backend, packed, joints):
        counts = clearance.counts(frames)
        return obstacle_loss_reference(joints, packed, counts, clearance.radii, margin, reduction)
    if torch.compiler.is_compiling():
        traced: Tensor = torch.ops.controlmm.obstacle_loss(
            joints, *native_arguments(packed, clearance), clearance.margin, reduction == "mean"
        )
        return traced
    arguments = native_arguments(packed, clearance)
    if joints.requires_grad and torch.is_grad_enabled():
        result: Tensor = _ObstacleLoss.apply(joints, arguments, clearance.margin, reduction == "mean")
        return result
    return obstacle_loss_forward(joints, arguments, clearance.margin, reduction == "mean")


def check_obstacle_reduction(reduction: str) -> None:
    """Raises ValueError unless ``reduction`` is "mean" or "sum"."""
    if reduction not in get_args(ObstacleReduction):
        raise ValueError(f"`reduction` must be one of {get_args(ObstacleReduction)}, got {reduction!r}.")


def packed_for(
    obstacles: Sequence[Obstacle] | PackedObstacles, batch: int, frames: int, like: Tensor
) -> PackedObstacles:
    """The obstacles packed in the dtype of ``like`` and checked against (batch, frames).

    Raises:
        TypeError: If an entry is no obstacle.
        ValueError: If obstacles move over another number of clips or frames, or have another dtype.
    """
    packed = (
        obstacles if isinstance(obstacles, PackedObstacles) else pack_obstacles(obstacles, dtype=like.dtype)
    )
    own_batch, _, _, own_frames = packed.parameters.shape
    if own_batch not in (1, batch) or own_frames not in (1, frames):
        raise ValueError(
            f"`obstacles` must move over the {batch} clips and {frames} frames of the joints, "
            f"got {own_batch} clips and {own_frames} frames."
        )
    if packed.parameters.dtype != like.dtype:
        raise ValueError(
            f"`obstacles` were packed as {packed.parameters.dtype}, the joints are {like.dtype}."
        )
    if packed.parameters.device == like.device:
        return packed
    return PackedObstacles(*(t.to(like.device) for t in (packed.kinds, packed.parameters, packed.heights)))


def obstacles_run_native(backend: Backend | None, packed: PackedObstacles, *tensors: Tensor) -> bool:
    """``runs_native``, but obstacles that want gradients need the reference.

    Raises:
        ValueError: If "native" was asked for and cannot run.
    """
    if torch.is_grad_enabled() and (packed.parameters.requires_grad or packed.heights.requires_grad):
        if requested_backend(backend) == "native":
            raise ValueError(
                "`backend='native'` cannot run: an obstacle requires gradients, which only the reference "
                "gives. Use 'auto' or 'reference', or detach the obstacle's tensors."
            )
        return False
    return runs_native(backend, *tensors)


def native_arguments(packed: PackedObstacles, clearance: Clearance) -> tuple[Tensor, ...]:
    """Obstacles and clearance in the order in which the kernels take them."""
    return (
        packed.kinds,
        packed.parameters.detach(),
        packed.heights.detach(),
        clearance.radii.detach(),
        clearance.is_active,
        clearance.lengths,
    )


def obstacle_loss_forward(
    joints: Tensor, arguments: tuple[Tensor, ...], margin: float, is_mean: bool
) -> Float[Tensor, "B"]:
    """The kernel alone, without autograd; ``arguments`` as given by ``native_arguments``."""
    loss = joints.new_empty(joints.shape[0])
    core().obstacle_loss(joints, *arguments, margin, is_mean, loss, torch.get_num_threads())
    return loss


def obstacle_loss_backward(
    joints: Tensor, arguments: tuple[Tensor, ...], margin: float, is_mean: bool, grad_loss: Tensor
) -> Float[Tensor, "B T J 3"]:
    """The gradient kernel alone, with respect to ``joints``."""
    grad = torch.empty_like(joints)
    core().obstacle_loss_backward(
        joints, *arguments, margin, is_mean, grad_loss, grad, torch.get_num_threads()
    )
    return grad


class _ObstacleLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, joints: Tensor, arguments: tuple[Tensor, ...], margin: float, is_mean: bool
    ) -> Tensor:
        ctx.save_for_backward(joints)
        ctx.arguments = arguments, margin, is_mean
        return obstacle_loss_forward(joints, arguments, margin, is_mean)

    @staticmethod
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor, None, None, None]:
        refuse_second_derivative("obstacle_loss")
        (joints,) = ctx.saved_tensors
        arguments, margin, is_mean = ctx.arguments
        return obstacle_loss_backward(joints, arguments, margin, is_mean, grad_loss), None, None, None
