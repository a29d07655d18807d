"""Value and gradient of the editing losses, straight from a decoder's output."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.ops.backend import Backend, core, runs_native
from controlmm.ops.clearance import Clearance, resolve_clearance
from controlmm.ops.consistency import NORM_CODES, Norm, check_consistency_arguments
from controlmm.ops.obstacle_loss import (
    ObstacleReduction,
    check_obstacle_reduction,
    native_arguments,
    packed_for,
)
from controlmm.ops.obstacles import Obstacle, PackedObstacles, pack_obstacles
from controlmm.ops.reference import masked_consistency_loss_reference, recover_joints_reference
from controlmm.ops.signed_distance import obstacle_loss_reference


def guidance_value_and_grad(
    decoded: Float[Tensor, "B D T"],
    targets: Float[Tensor, "B T J 3"],
    mask: Bool[Tensor, "B T J"] | Bool[Tensor, "B T J 3"],
    obstacles: Sequence[Obstacle] | PackedObstacles = (),
    *,
    mean: Float[Tensor, "D"],
    std: Float[Tensor, "D"],
    norm: Norm = "l2",
    obstacle_weight: float = 1.0,
    margin: float = 0.0,
    joint_radius: float | Float[Tensor, "J"] = 0.0,
    joint_indices: Sequence[int] | None = None,
    lengths: Int[Tensor, "B"] | None = None,
    reduction: ObstacleReduction = "mean",
    out: Float[Tensor, "B D T"] | None = None,
    backend: Backend | None = None,
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B D T"]]:
    """Control loss plus ``obstacle_weight`` times obstacle loss of each clip, and its gradient in
    ``decoded``.

    De-normalises, recovers joints, compares and differentiates in one pass, without a tensor of joints. Both
    results are plain values outside any autograd graph: continue with ``decoded.backward(gradient)``. Clip by
    clip the loss is that of ``masked_consistency_loss(reduction="clip")`` and ``obstacle_loss``.

    Args:
        decoded: Normalised features as a convolutional decoder emits them, channels before frames. Any
            strides.
        targets: Wanted positions in metres; fastest if frames are contiguous in memory (see ``frames_last``).
        mask: True where controlled, for each joint or each coordinate; frames past a clip's end are not
            masked.
        obstacles: Primitives, or better the result of ``pack_obstacles``.
        mean: Features are decoded * std + mean.
        std: See ``mean``.
        norm: As in ``masked_consistency_loss``.
        obstacle_weight: Factor of the obstacle loss.
        margin: Safe distance to obstacles in metres.
        joint_radius: Each joint is a ball of this radius in metres.
        joint_indices: Joints that count against obstacles; ``None`` counts all.
        lengths: Frames that count against obstacles in each clip.
        reduction: Of the obstacle loss, "mean" or "sum".
        out: A gradient that an earlier call of this function returned, to be overwritten; saves allocating
            it.
        backend: "native", "reference" or "auto"; ``None`` asks the context and the environment.

    Raises:
        TypeError: If a dtype does not fit.
        ValueError: If a shape or value does not fit, or "native" was asked for and cannot run.
    """
    _check_decoded(decoded, targets, mean, std, out)
    check_consistency_arguments(targets, targets, mask, norm)
    check_obstacle_reduction(reduction)
    batch, frames, joints = targets.shape[:3]
    packed = _packed(obstacles, batch, frames, decoded)
    clearance = resolve_clearance(
        (batch, frames, joints), decoded,
        margin=margin, joint_radius=joint_radius, joint_indices=joint_indices, lengths=lengths,
    )  # fmt: skip
    full_mask = mask if mask.ndim == 4 else mask[..., None].expand(*mask.shape, 3)
    is_mean = reduction == "mean"
    if not runs_native(backend, decoded, targets, mean, std):
        loss, gradient = _guidance_reference(
            decoded, targets, full_mask, mean, std, norm, packed, clearance, is_mean, obstacle_weight
        )
        return loss, gradient if out is None else out.copy_(gradient)
    scalars = (clearance.margin, is_mean, obstacle_weight)
    if torch.compiler.is_compiling():
        tensors = [tensor.detach() for tensor in (decoded, mean, std, targets)]
        loss, gradient = torch.ops.controlmm.guidance_value_and_grad(
            *tensors, full_mask, norm, *native_arguments(packed, clearance), *scalars
        )
        return loss, gradient if out is None else out.copy_(gradient)
    gradient = torch.zeros_like(decoded, requires_grad=False) if out is None else out
    if len(packed) == 0:
        return _control_native(decoded, mean, std, targets, full_mask, norm, gradient), gradient
    arguments = native_arguments(packed, clearance)
    loss = guidance_native(decoded, mean, std, targets, full_mask, norm, arguments, *scalars, gradient)
    return loss, gradient


def _control_native(
    decoded: Tensor,
    mean: Tensor,
    std: Tensor,
    targets: Tensor,
    mask: Tensor,
    norm: Norm,
    gradient: Tensor,
) -> Float[Tensor, "B"]:
    """The kernel alone, without obstacles: about half of the tensors to hand over."""
    loss = decoded.new_empty(decoded.shape[0])
    core().control_value_and_grad(
        decoded, mean, std, targets, mask, NORM_CODES[norm], loss, gradient, torch.get_num_threads()
    )
    return loss


def guidance_native(
    decoded: Tensor,
    mean: Tensor,
    std: Tensor,
    targets: Tensor,
    mask: Tensor,
    norm: Norm,
    obstacle_arguments: tuple[Tensor, ...],
    margin: float,
    is_mean: bool,
    obstacle_weight: float,
    gradient: Tensor,
) -> Float[Tensor, "B"]:
    """The kernel alone: writes ``gradient`` and returns the loss."""
    loss = decoded.new_empty(decoded.shape[0])
    core().guidance_value_and_grad(
        decoded, mean, std, targets, mask, NORM_CODES[norm], *obstacle_arguments, margin, is_mean,
        obstacle_weight, loss, gradient, torch.get_num_threads(),
    )  # fmt: skip
    return loss


def frames_last(tensor: Tensor) -> Tensor:
    """The same (B, T, J, 3) tensor with frames contiguous in memory: the layout that guidance reads
    fastest."""
    return tensor.movedim(1, -1).contiguous().movedim(-1, 1)


def _check_decoded(decoded: Tensor, targets: Tensor, mean: Tensor, std: Tensor, out: Tensor | None) -> None:
    if not decoded.is_floating_point() or {targets.dtype, mean.dtype, std.dtype} != {decoded.dtype}:
        raise TypeError(
            "`decoded`, `targets`, `mean` and `std` must share one floating-point dtype, "
            f"got {decoded.dtype}, {targets.dtype}, {mean.dtype} and {std.dtype}."
        )
    if decoded.ndim != 3 or targets.ndim != 4 or targets.shape[:2] != (decoded.shape[0], decoded.shape[2]):
        raise ValueError(
            "`decoded` must have shape (B, D, T) and `targets` (B, T, J, 3), "
            f"got {tuple(decoded.shape)} and {tuple(targets.shape)}."
        )
    if mean.shape != decoded.shape[1:2] or std.shape != decoded.shape[1:2]:
        raise ValueError(
            f"`mean` and `std` must have shape ({decoded.shape[1]},), "
            f"got {tuple(mean.shape)} and {tuple(std.shape)}."
        )
    needed = 4 + 3 * (targets.shape[2] - 1)
    if targets.shape[2] < 1 or decoded.shape[1] < needed:
        raise ValueError(
            f"`decoded` must have at least {needed} channels for the {targets.shape[2]} joints of `targets`, "
            f"got {decoded.shape[1]}."
        )
    if out is not None and (out.shape != decoded.shape or out.dtype != decoded.dtype or out.requires_grad):
        raise ValueError(
            f"`out` must be a gradient from an earlier call, {tuple(decoded.shape)} {decoded.dtype}, "
            f"got {tuple(out.shape)} {out.dtype}."
        )


@functools.lru_cache(maxsize=4)
def _no_obstacles(dtype: torch.dtype) -> PackedObstacles:
    return pack_obstacles((), dtype=dtype)


def _packed(
    obstacles: Sequence[Obstacle] | PackedObstacles, batch: int, frames: int, like: Tensor
) -> PackedObstacles:
    if len(obstacles) == 0:
        obstacles = _no_obstacles(like.dtype)
    return packed_for(obstacles, batch, frames, like)


def _guidance_reference(
    decoded: Tensor,
    targets: Tensor,
    mask: Tensor,
    mean: Tensor,
    std: Tensor,
    norm: Norm,
    packed: PackedObstacles,
    clearance: Clearance,
    is_mean: bool,
    obstacle_weight: float,
) -> tuple[Tensor, Tensor]:
    with torch.enable_grad():
        leaf = decoded.detach().requires_grad_()
        joints = recover_joints_reference(
            leaf.transpose(1, 2) * std.detach() + mean.detach(), targets.shape[2]
        )
        loss = masked_consistency_loss_reference(joints, targets.detach(), mask, norm, "clip")
        if len(packed):
            counts = clearance.counts(targets.shape[1])
            reduction = "mean" if is_mean else "sum"
            loss = loss + obstacle_weight * obstacle_loss_reference(
                joints, packed, counts, clearance.radii, clearance.margin, reduction
            )
        (gradient,) = torch.autograd.grad(loss.sum(), leaf)
    return loss.detach(), gradient
