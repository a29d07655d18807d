"""Clips of one length, which networks can take together without padding."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Int
from torch import Tensor

_TOGETHER = 8  # of 196 frames: what a layer makes of them stays in a processor's caches


def clips_by_length(lengths: Sequence[int]) -> list[tuple[int, Int[Tensor, "N"]]]:
    """(length, clips) of up to eight clips each; every clip is in one of the groups.

    What networks say of a clip then depends neither on the clips beside it nor on how far they reach.
    """
    rows: dict[int, list[int]] = {}
    for clip, length in enumerate(lengths):
        rows.setdefault(length, []).append(clip)
    return [
        (length, torch.tensor(clips[first : first + _TOGETHER]))
        for length, clips in sorted(rows.items())
        for first in range(0, len(clips), _TOGETHER)
    ]
