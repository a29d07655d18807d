"""Checks of what a user passes to a control: joints, frames and points."""

from __future__ import annotations

import difflib
import operator
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.motion.skeleton import HUMANML3D, SKELETONS, Skeleton

AXES = "xyz"
# What other skeletons call our joints, for suggestions.
_OTHER_WORDS = {"hand": "wrist", "toe": "foot", "hips": "pelvis", "root": "pelvis", "chest": "spine3"}


def resolve_joint(joint: str | int, skeleton: Skeleton) -> int:
    """Index of a joint of ``skeleton`` given by name or index.

    Raises:
        ValueError: If the skeleton has no such joint; the message suggests the nearest name.
    """
    if isinstance(joint, str) and joint not in skeleton.joint_names:
        raise ValueError(_unknown_joint(joint, skeleton))
    return skeleton.joint_index(joint)


def check_joint(joint: str | int) -> str | int:
    """The joint, if a known skeleton has it; which skeleton counts is known only when a clip is made.

    Raises:
        TypeError: If it is neither a name nor an index.
        ValueError: If no skeleton has it.
    """
    if isinstance(joint, str):
        if not any(joint in skeleton.joint_names for skeleton in SKELETONS.values()):
            raise ValueError(_unknown_joint(joint, HUMANML3D))
        return joint
    index = _as_integer(joint)
    if index is None:
        raise TypeError(f"`joint` must be a name such as 'pelvis' or an index, got {type(joint).__name__}.")
    return HUMANML3D.joint_index(index)


def parse_frames(frames: Iterable[int]) -> Int[Tensor, " N"]:
    """Frame numbers as int64, in the order given.

    Raises:
        TypeError: If ``frames`` is not a sequence.
        ValueError: If it is empty, or a frame is negative, not an integer, or there twice.
    """
    if isinstance(frames, (str, bytes)) or not isinstance(frames, Iterable):
        raise TypeError(f"`frames` must be a sequence of frame numbers, got {type(frames).__name__}.")
    numbers: list[int] = []
    for position, frame in enumerate(frames.tolist() if isinstance(frames, (Tensor, np.ndarray)) else frames):
        number = _as_integer(frame)
        if number is None:
            raise ValueError(
                f"`frames[{position}]` must be an integer, got {frame!r}. Frames count from 0 at 20 fps."
            )
        if number < 0:
            raise ValueError(
                f"`frames[{position}]` must not be negative, got {number}. The first frame is 0."
            )
        numbers.append(number)
    if not numbers:
        raise ValueError("`frames` is empty. Name at least one frame.")
    _refuse_doubles(numbers)
    return torch.tensor(numbers, dtype=torch.int64)


def parse_points(values: Any, *, name: str) -> tuple[Float[Tensor, "..."], Bool[Tensor, "..."]]:
    """Coordinates as float32 (0 where free), and a mask that is false where ``values`` holds ``None``.

    Raises:
        ValueError: If ``values`` is ragged or holds something that is not a number. NaN and infinity pass
            here, :func:`check_finite` knows the frame.
    """
    if isinstance(values, Tensor):
        values = values.detach().cpu().numpy()
    try:
        cells = np.array(values, dtype=object)
        is_free = np.vectorize(lambda cell: cell is None, otypes=[bool])(cells)
        is_text = np.vectorize(lambda cell: isinstance(cell, (str, bytes)), otypes=[bool])(cells)
        if is_text.any():  # NumPy would turn "1.5" into a number
            raise TypeError("text")
        numbers = np.where(is_free, 0.0, cells).astype(np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"`{name}` must be a rectangular array of numbers (or None for a free axis)."
        ) from error
    with np.errstate(over="ignore"):  # infinity is reported by `check_finite`
        return torch.from_numpy(numbers.astype(np.float32)), torch.as_tensor(~is_free)


def check_finite(points: Float[Tensor, "N *D"], *, name: str, frames: Int[Tensor, " N"] | None) -> None:
    """Refuse NaN and infinity.

    Raises:
        ValueError: Naming the first bad row, and its frame if ``frames`` are known.
    """
    bad_rows = (~torch.isfinite(points)).flatten(1).any(1).nonzero()
    if not len(bad_rows):
        return
    row = int(bad_rows[0])
    place = f"`{name}[{row}]`" if frames is None else f"`{name}[{row}]` (frame {int(frames[row])})"
    shown = ", ".join(f"{value:g}" for value in points[row].flatten()[:3].tolist())
    values = f"({shown}{', ...' if points[row].numel() > 3 else ''})"
    raise ValueError(
        f"{place} must be finite, got {values}. Leave the frame out, or give None for a free axis."
    )


def check_some_axis(mask: Bool[Tensor, "N *D"], frames: Int[Tensor, " N"]) -> None:
    """Refuse a frame at which every axis is free.

    Raises:
        ValueError: Naming the first such frame.
    """
    idle = (~mask).flatten(1).all(1).nonzero()
    if len(idle):
        raise ValueError(f"Every axis is free at frame {int(frames[int(idle[0])])}. Leave that frame out.")


def _as_integer(value: Any) -> int | None:
    if isinstance(value, (bool, np.bool_)):
        return None
    try:
        return operator.index(value)
    except TypeError:
        return None


def _refuse_doubles(numbers: list[int]) -> None:
    seen: set[int] = set()
    for number in numbers:
        if number in seen:
            raise ValueError(f"`frames` names frame {number} twice. Give one target for each frame.")
        seen.add(number)


def _unknown_joint(joint: str, skeleton: Skeleton) -> str:
    name = joint.lower().replace(" ", "_")
    for word, ours in _OTHER_WORDS.items():
        name = name.replace(word, ours)
    near = difflib.get_close_matches(name, skeleton.joint_names, n=1)
    suggestion = f' Did you mean "{near[0]}"?' if near else ""
    names = ", ".join(skeleton.joint_names)
    return f'Unknown joint "{joint}".{suggestion} The {skeleton.name} skeleton has: {names}.'
