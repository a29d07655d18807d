"""Which coordinates of the six trajectories a training sample of TLControl may see."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from controlmm.training.control_masks import random_frames

Masking = Literal["mixed", "paper", "released"]

# Shares of our kinds for each clip; the rest are segments.
_ALL, _NONE, _SUBSET, _SPARSE, _PATH = 0.15, 0.12, 0.28, 0.25, 0.05
_PAPER_MOST = 0.75  # share of frames that the paper's curriculum masks in the end
_RELEASED_ALL, _RELEASED_JOINT = 0.1, 0.7  # the rest are segments
_RELEASED_STAGES = ((0.1, 0.2), (0.125, 0.4), (1.0, 0.5))  # until this progress, this share of the frames
_LONGEST_SEGMENT = 15  # frames


def given_coordinates(
    masking: Masking, frames: Bool[Tensor, "B T"], *, joints: int, progress: float
) -> Bool[Tensor, "B T P 3"]:
    """Random coordinates that are given, never behind the end of a clip.

    Args:
        masking: ``mixed`` (ours: each clip on its own draws everything, nothing, some joints, sparse
            keyframes, a ground path, or all but segments), ``paper`` or ``released`` (the published code).
        frames: Frames of each clip.
        joints: Number of trajectories.
        progress: 0 at the start of training, 1 at its end; the published strategies hide more and more.
    """
    strategies: dict[str, Callable[..., Tensor]] = {
        "mixed": mixed_trajectories,
        "paper": paper_trajectories,
        "released": released_trajectories,
    }
    if masking not in strategies:
        raise ValueError(f"Unknown masking {masking!r}. Use one of: {', '.join(strategies)}.")
    given: Tensor = strategies[masking](frames, joints, progress)
    return given & frames[:, :, None, None]


def mixed_trajectories(
    frames: Bool[Tensor, "B T"], joints: int, _progress: float = 0.0
) -> Bool[Tensor, "B T P 3"]:
    """Ours: every clip on its own, all the ways in which people give targets."""
    given = torch.zeros(*frames.shape, joints, 3, dtype=torch.bool)
    for clip, length in zip(given, frames.sum(1).tolist(), strict=True):
        kind = torch.rand(()).item()
        chosen = _random_subset(joints)
        if kind < _ALL:
            clip[:] = True
        elif kind < _ALL + _NONE:
            continue
        elif kind < _ALL + _NONE + _SUBSET:
            clip[:, chosen] = True
        elif kind < _ALL + _NONE + _SUBSET + _SPARSE:
            for joint in chosen:
                clip[random_frames(length), joint] = True
        elif kind < _ALL + _NONE + _SUBSET + _SPARSE + _PATH:
            at = random_frames(length)
            clip[at, 0, 0] = clip[at, 0, 2] = True
        else:
            share = torch.rand(()).item()
            for joint in chosen:
                clip[:, joint] = ~hide_segments(len(clip), share, span=length)[:, None]
    return given


def paper_trajectories(frames: Bool[Tensor, "B T"], joints: int, progress: float) -> Bool[Tensor, "B T P 3"]:
    """The paper: half the batches hide a random number of joints, the others up to 75 % of the frames."""
    batch, length = frames.shape
    if torch.rand(()) < 0.5:
        return _kept_joints(joints, kept=int(torch.randint(joints + 1, ()))).expand(batch, length, joints, 3)
    return _segment_mask(length, joints, _PAPER_MOST * progress).expand(batch, length, joints, 3)


def released_trajectories(
    frames: Bool[Tensor, "B T"], joints: int, progress: float
) -> Bool[Tensor, "B T P 3"]:
    """The released code: everything, all but one joint hidden, or segments; one draw for the whole batch."""
    batch, length = frames.shape
    kind = torch.rand(()).item()
    if kind < _RELEASED_ALL:
        return torch.ones(batch, length, joints, 3, dtype=torch.bool)
    if kind < _RELEASED_ALL + _RELEASED_JOINT:
        return _kept_joints(joints, kept=1).expand(batch, length, joints, 3)
    share = next((share for until, share in _RELEASED_STAGES if progress < until), _RELEASED_STAGES[-1][1])
    return _segment_mask(length, joints, share).expand(batch, length, joints, 3)


def _random_subset(joints: int) -> list[int]:
    order: list[int] = torch.randperm(joints).tolist()
    return order[: int(torch.randint(1, joints + 1, ()))]


def _kept_joints(joints: int, *, kept: int) -> Bool[Tensor, "P 1"]:
    mask = torch.zeros(joints, 1, dtype=torch.bool)
    mask[torch.randperm(joints)[:kept]] = True
    return mask


def _segment_mask(length: int, joints: int, share: float) -> Bool[Tensor, "T P 1"]:
    return ~torch.stack([hide_segments(length, share, span=length) for _ in range(joints)], dim=1)[..., None]


def hide_segments(frames: int, share: float, *, span: int) -> Bool[Tensor, "T"]:
    """True in random segments of at most 15 frames that cover ``share`` of the first ``span`` frames."""
    hidden = torch.zeros(frames, dtype=torch.bool)
    wanted = round(share * span)
    while (missing := wanted - int(hidden.sum())) > 0:
        size = int(torch.randint(1, _LONGEST_SEGMENT + 1, ())) if missing > _LONGEST_SEGMENT else missing
        first = max(0, int(torch.randint(span, ())) - size // 2)
        hidden[first : min(span, first + size)] = True
    return hidden
