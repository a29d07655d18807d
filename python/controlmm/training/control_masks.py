"""Which coordinates are controlled in a training sample."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Int
from torch import Tensor

MaskMode = Literal["mixed", "trajectory", "random", "cross"]

_LONGEST = 196  # frames; the published modes draw the number of controlled ones up to it, whatever the clip's

# Shares of the kinds of control in training. The published modes are `trajectory` and `cross` with a uniform
# density; ours is heavy on sparse targets, which people give, and keeps a share without any control.
_NO_CONTROL, _PATH, _TRAJECTORY, _POSE = 0.1, 0.2, 0.2, 0.1  # the rest: some joints at some frames
_FREE_AXES = 0.1  # of these joints are held along one or two axes only


def mixed_masks(
    frames: Bool[Tensor, "B T"], *, joints: int, favoured: Sequence[int]
) -> Bool[Tensor, "B T J 3"]:
    """Random control masks of all kinds: ground path, pelvis trajectory, poses, joints at frames, nothing.

    Args:
        frames: Frames of each clip.
        joints: Joints of the skeleton.
        favoured: Joints that half of the joint controls are drawn from (the papers' six).
    """
    masks = torch.zeros(*frames.shape, joints, 3, dtype=torch.bool)
    for mask, length in zip(masks, frames.sum(1).tolist(), strict=True):
        kind = torch.rand(()).item()
        at = random_frames(length)
        if kind < _NO_CONTROL:
            continue
        if kind < _NO_CONTROL + _PATH:
            mask[at, 0, 0] = True
            mask[at, 0, 2] = True
        elif kind < _NO_CONTROL + _PATH + _TRAJECTORY:
            mask[at, 0] = True
        elif kind < _NO_CONTROL + _PATH + _TRAJECTORY + _POSE:
            mask[at[:5]] = True
        else:
            for joint in _random_joints(joints, favoured):
                mask[random_frames(length)[:, None], joint, _random_axes()] = True
    return masks


def sample_masks(
    mode: MaskMode, frames: Bool[Tensor, "B T"], *, joints: int, among: Sequence[int]
) -> Bool[Tensor, "B T J 3"]:
    """Random control masks of a named kind.

    ``trajectory``, ``random`` and ``cross`` are the published ones: the root at a uniform number of frames,
    one joint a clip likewise, a uniform number of (frame, joint) pairs. ``mixed`` is ours: all joints, ground
    paths and whole poses too, sparse more often than dense.

    Args:
        mode: Which kind.
        frames: Frames of each clip.
        joints: Joints of the skeleton.
        among: The six joints of the papers.
    """
    if mode == "trajectory":
        return trajectory_masks(frames, joints=joints)
    if mode == "random":
        return random_masks(frames, joints=joints, among=among)
    if mode == "cross":
        return cross_masks(frames, joints=joints, among=among)
    return mixed_masks(frames, joints=joints, favoured=among)


def random_frames(length: int) -> Int[Tensor, "N"]:
    """Between 1 and ``length`` distinct frames; their number is log-uniform: sparse control is common."""
    count = int(torch.exp(torch.rand(()) * torch.tensor(float(length) + 1).log()))
    return torch.randperm(length)[: max(1, min(count, length))]


def trajectory_masks(frames: Bool[Tensor, "B T"], *, joints: int) -> Bool[Tensor, "B T J 3"]:
    """Published mode ``trajectory``: the pelvis at a uniform number of frames."""
    return _one_joint_masks(frames, joints=joints, among=(0,))


def random_masks(
    frames: Bool[Tensor, "B T"], *, joints: int, among: Sequence[int]
) -> Bool[Tensor, "B T J 3"]:
    """Published mode ``random``: one joint of ``among`` a clip, at a uniform number of frames."""
    return _one_joint_masks(frames, joints=joints, among=among)


def _one_joint_masks(
    frames: Bool[Tensor, "B T"], *, joints: int, among: Sequence[int]
) -> Bool[Tensor, "B T J 3"]:
    masks = torch.zeros(*frames.shape, joints, 3, dtype=torch.bool)
    for mask, length in zip(masks, frames.sum(1).tolist(), strict=True):
        count = max(1, round(torch.rand(()).item() * _LONGEST))
        joint = among[int(torch.randint(len(among), ()))]
        mask[torch.randperm(length)[: min(count, length)], joint] = True
    return masks


def cross_masks(frames: Bool[Tensor, "B T"], *, joints: int, among: Sequence[int]) -> Bool[Tensor, "B T J 3"]:
    """Published mode ``cross``: a uniform number of (frame, joint) pairs among the joints ``among``."""
    masks = torch.zeros(*frames.shape, joints, 3, dtype=torch.bool)
    for mask, length in zip(masks, frames.sum(1).tolist(), strict=True):
        pairs = length * len(among)
        chosen = torch.randperm(pairs)[: max(1, round(torch.rand(()).item() * pairs))]
        mask[chosen // len(among), torch.tensor(among)[chosen % len(among)]] = True
    return masks


def _random_axes() -> Int[Tensor, "A"]:
    """All three axes, or now and then one or two of them."""
    count = 1 + int(torch.randint(2, ())) if torch.rand(()) < _FREE_AXES else 3
    return torch.randperm(3)[:count]


def _random_joints(joints: int, favoured: Sequence[int]) -> list[int]:
    pool = list(favoured) if torch.rand(()) < 0.5 else list(range(joints))
    count = 1 + int(torch.rand(()).square() * min(len(pool), 6))
    order: list[int] = torch.randperm(len(pool)).tolist()
    return [pool[i] for i in order[:count]]
