"""Which joints and frames count against obstacles, and how large a joint is."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Clearance:
    """Arguments of an obstacle loss, resolved to tensors."""

    radii: Float[Tensor, "J"]  # metres
    is_active: Bool[Tensor, "J"]
    lengths: Int[Tensor, "B"]  # frames that count
    margin: float  # metres

    def counts(self, frames: int) -> Bool[Tensor, "B T J"]:
        """True for each frame and joint that counts."""
        in_length = torch.arange(frames, device=self.lengths.device) < self.lengths[:, None]
        return in_length[..., None] & self.is_active


def resolve_clearance(
    shape: tuple[int, int, int],
    like: Tensor,
    *,
    margin: float,
    joint_radius: float | Float[Tensor, "J"],
    joint_indices: Sequence[int] | None,
    lengths: Int[Tensor, "B"] | None,
) -> Clearance:
    """Check and fill in the arguments for joints of ``shape`` (B, T, J), of the dtype and device of ``like``.

    Raises:
        ValueError: If ``margin`` or a radius is negative, an index is no joint, or a length exceeds T.
    """
    batch, frames, joints = shape
    if not margin >= 0:
        raise ValueError(f"`margin` must be at least 0 m, got {margin}.")
    indices = None if joint_indices is None else tuple(int(index) for index in joint_indices)
    is_active = _active_joints(joints, indices).to(like.device)
    if lengths is None:
        lengths = _all_frames(batch, frames).to(like.device)
    elif lengths.shape != (batch,) or not _all_between(lengths, 0, frames):
        raise ValueError(f"`lengths` must be {batch} values between 0 and {frames}, got {lengths.tolist()}.")
    radii = _radii(joint_radius, joints, like)
    return Clearance(radii, is_active, lengths.to(torch.int64).contiguous(), float(margin))


def _radii(joint_radius: float | Tensor, joints: int, like: Tensor) -> Float[Tensor, "J"]:
    if not isinstance(joint_radius, Tensor):
        if not joint_radius >= 0:
            raise ValueError(f"`joint_radius` must be at least 0 m, got {joint_radius}.")
        return _equal_radii(joints, float(joint_radius), like.dtype).to(like.device)
    if joint_radius.shape != (joints,) or not _all_between(joint_radius, 0, float("inf")):
        raise ValueError(
            f"`joint_radius` must be {joints} values of at least 0 m, got {joint_radius.tolist()}."
        )
    return joint_radius.to(like).contiguous()


def _all_between(values: Tensor, low: float, high: float) -> bool:
    if torch.compiler.is_compiling():
        return True  # values are not known while tracing; the kernels check lengths again
    return bool(((values >= low) & (values <= high)).all())


# An editing loop asks for the same few of these at every step.
@functools.lru_cache(maxsize=64)
def _equal_radii(joints: int, radius: float, dtype: torch.dtype) -> Float[Tensor, "J"]:
    return torch.full((joints,), radius, dtype=dtype)


@functools.lru_cache(maxsize=64)
def _all_frames(batch: int, frames: int) -> Int[Tensor, "B"]:
    return torch.full((batch,), frames, dtype=torch.int64)


@functools.lru_cache(maxsize=64)
def _active_joints(joints: int, indices: tuple[int, ...] | None) -> Bool[Tensor, "J"]:
    if indices is None:
        return torch.ones(joints, dtype=torch.bool)
    if not all(0 <= index < joints for index in indices):
        raise ValueError(f"`joint_indices` must lie between 0 and {joints - 1}, got {list(indices)}.")
    active = torch.zeros(joints, dtype=torch.bool)
    active[list(indices)] = True
    return active
