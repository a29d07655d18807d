"""Random windows of fixed length, balanced over the sources of the data."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from controlmm.data.clip import FeatureClip
from controlmm.motion.normalizer import Normalizer

SOURCE_BALANCE = 0.5  # a source's share goes with its size to this power: 1 as it comes, 0 all alike


def source_weights(sources: Sequence[str], sizes: Sequence[int]) -> Float[Tensor, "N"]:
    """Weight of each item so that large sources do not drown small ones (``SOURCE_BALANCE``)."""
    totals: dict[str, float] = {}
    for source, size in zip(sources, sizes, strict=True):
        totals[source] = totals.get(source, 0.0) + size
    return torch.tensor(
        [size * totals[source] ** (SOURCE_BALANCE - 1) for source, size in zip(sources, sizes, strict=True)]
    )


class WindowSampler:
    """All windows of ``length`` frames of all clips that are long enough, normalised.

    Raises:
        ValueError: If no clip is long enough.
    """

    def __init__(self, clips: Sequence[FeatureClip], normalizer: Normalizer, *, length: int) -> None:
        clips = [clip for clip in clips if len(clip.features) >= length]
        if not clips:
            raise ValueError(f"No clip has {length} frames or more; training windows need that many.")
        self.length = length
        self.frames = torch.cat([normalizer.normalize(clip.features) for clip in clips])
        counts = torch.tensor([len(clip.features) - length + 1 for clip in clips])
        ends = torch.tensor([len(clip.features) for clip in clips]).cumsum(0)
        self._first_frame = ends - counts - length + 1
        self._counts = counts
        self._weights = source_weights([clip.source for clip in clips], counts.tolist())

    def sample(self, count: int) -> Float[Tensor, "B T D"]:
        """``count`` windows from torch's global random state."""
        clip = torch.multinomial(self._weights, count, replacement=True)
        offset = (torch.rand(count) * self._counts[clip]).long()
        return self.at(self._first_frame[clip] + offset)

    def at(self, starts: Int[Tensor, "B"]) -> Float[Tensor, "B T D"]:
        """The windows that begin at frames ``starts`` of the concatenated clips."""
        return self.frames[starts[:, None] + torch.arange(self.length)]


class PaddedClipSampler:
    """Whole clips with zeros behind them, normalised: what the published TLControl tokenizer was trained on.

    Raises:
        ValueError: If there is no clip.
    """

    def __init__(self, clips: Sequence[FeatureClip], normalizer: Normalizer, *, length: int) -> None:
        if not clips:
            raise ValueError("The training split has no readable clip.")
        self.length = length
        self._clips = [normalizer.normalize(clip.features) for clip in clips]
        self._weights = source_weights([clip.source for clip in clips], [1] * len(clips))

    def sample(self, count: int) -> Float[Tensor, "B T D"]:
        """``count`` padded clips from torch's global random state; too long ones are cut at random."""
        chosen = torch.multinomial(self._weights, count, replacement=True).tolist()
        batch = torch.zeros(count, self.length, self._clips[0].shape[1])
        for row, index in zip(batch, chosen, strict=True):
            clip = self._clips[index]
            first = int(torch.randint(max(0, len(clip) - self.length) + 1, ()))
            clip = clip[first : first + self.length]
            row[: len(clip)] = clip
        return batch
