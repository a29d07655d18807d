"""What the operators on one clip in double precision require of their arguments."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from numbers import Integral

import torch
from jaxtyping import Bool
from torch import Tensor


def check_clip(name: str, clip: Tensor, held: Tensor, planted: Tensor, parents: Sequence[int]) -> None:
    """Raises ValueError or TypeError unless clip, flags and hierarchy fit."""
    check_parents(parents)
    _check_float64(name, clip)
    if clip.ndim != 3 or clip.shape[1:] != (len(parents), 3):
        raise ValueError(f"`{name}` must have shape (T, {len(parents)}, 3), got {tuple(clip.shape)}.")
    for other, flags, shape in (("held", held, clip.shape), ("planted", planted, clip.shape[:2])):
        if not isinstance(flags, Tensor):
            raise TypeError(f"`{other}` must be a boolean tensor, got {type(flags).__name__}.")
        if flags.dtype != torch.bool or flags.shape != shape:
            came = f"{flags.dtype} of {tuple(flags.shape)}"
            raise ValueError(f"`{other}` must be boolean of shape {tuple(shape)}, got {came}.")


def check_parents(parents: Sequence[int]) -> None:
    """Raises TypeError or ValueError unless each joint but the first names an earlier one."""
    if not all(isinstance(parent, Integral) for parent in parents):
        raise TypeError(f"`parents` must be whole numbers, got {parents}.")
    fits = [parent == -1 if joint == 0 else 0 <= parent < joint for joint, parent in enumerate(parents)]
    if not fits or not all(fits):
        raise ValueError(
            "`parents` must be -1 for the first joint and name an earlier joint for every other, "
            f"got {parents}."
        )


def check_lengths(lengths: Tensor, parents: Sequence[int]) -> None:
    """Raises TypeError or ValueError unless there is one float64 for each joint."""
    _check_float64("lengths", lengths)
    if lengths.shape != (len(parents),):
        raise ValueError(f"`lengths` must have shape ({len(parents)},), got {tuple(lengths.shape)}.")


def check_swing(rotations: Tensor, before: Tensor, after: Tensor, heading: Tensor) -> None:
    """Raises TypeError or ValueError unless the rotations, joints and headings are of one clip."""
    named = {"rotations": rotations, "before": before, "after": after, "heading": heading}
    for name, tensor in named.items():
        _check_float64(name, tensor)
    if before.ndim != 3 or before.shape[1] < 1 or before.shape[2] != 3:
        raise ValueError(f"`before` must have shape (T, J, 3) with J >= 1, got {tuple(before.shape)}.")
    frames, joints = before.shape[:2]
    shapes = {"rotations": (frames, joints - 1, 6), "after": (frames, joints, 3), "heading": (frames, 4)}
    for name, shape in shapes.items():
        if named[name].shape != shape:
            raise ValueError(
                f"`{name}` must have shape {shape} to fit `before`, got {tuple(named[name].shape)}."
            )


def chain_bones(chains: Sequence[Sequence[int]], joints: int) -> tuple[list[int], list[bool]]:
    """Of every joint, the one before it in its chain (-1 for joint 0), and whether that one starts the chain.

    Raises TypeError or ValueError unless the chains lead to each joint but the first once, always onwards.
    """
    parents, starts = [-1] * joints, [True] * joints
    for chain in chains:
        _check_chain(chain, joints)
        for place, (parent, joint) in enumerate(pairwise(chain)):
            if joint <= parent:
                raise ValueError(
                    f"`chains` must go from earlier joints to later ones, got {joint} after {parent}."
                )
            if parents[joint] >= 0:
                raise ValueError(f"`chains` must lead to each joint once, got {joint} again.")
            parents[joint], starts[joint] = int(parent), place == 0
    missing = [joint for joint in range(1, joints) if parents[joint] < 0]
    if missing:
        raise ValueError(
            f"`chains` must lead to each of {joints} joints but the first, got none to {missing}."
        )
    return parents, starts


def _check_chain(chain: Sequence[int], joints: int) -> None:
    if not isinstance(chain, Sequence):
        raise TypeError(f"`chains` must be sequences of joints, got {chain!r} among them.")
    for joint in chain:
        if not isinstance(joint, Integral):
            raise TypeError(f"`chains` must hold indices of joints, got {joint!r}.")
        if not 0 <= joint < joints:
            raise ValueError(f"`chains` must lie within [0, {joints}), got {joint}.")


def check_effort(enough: float, steps: int) -> None:
    """Raises TypeError or ValueError unless the error is positive and the number of steps is one."""
    if not isinstance(steps, Integral):
        raise TypeError(f"`steps` must be a whole number, got {type(steps).__name__}.")
    if steps < 0:
        raise ValueError(f"`steps` must not be negative, got {steps}.")
    check_positive("enough", enough)


def check_positive(name: str, value: float) -> None:
    """Raises ValueError unless the length is positive; NaN is not."""
    if not value > 0:
        raise ValueError(f"`{name}` must be a positive length, got {value}.")


def joint_flags(name: str, joints: Sequence[int], parents: Sequence[int]) -> Bool[Tensor, "J"]:
    """True for the joints named. Raises TypeError or ValueError for what is no joint."""
    flags = torch.zeros(len(parents), dtype=torch.bool)
    for joint in joints:
        if not isinstance(joint, Integral):
            raise TypeError(f"`{name}` must be indices of joints, got {joint!r}.")
        if not 0 <= joint < len(parents):
            raise ValueError(f"`{name}` must lie within [0, {len(parents)}), got {joint}.")
        flags[int(joint)] = True
    return flags


def _check_float64(name: str, tensor: Tensor) -> None:
    if not isinstance(tensor, Tensor):
        raise TypeError(f"`{name}` must be a float64 tensor, got {type(tensor).__name__}.")
    if tensor.dtype != torch.float64:
        raise TypeError(f"`{name}` must be float64, got {tensor.dtype}.")
