"""Batches of motions with a sentence each, for the evaluator's contrastive training."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from controlmm.data.clip import FeatureClip
from controlmm.training.windows import source_weights

MIN_FRAMES, MAX_FRAMES, UNIT = 24, 196, 4
_SAME_MEANING = 0.75  # cosine of two sentences' features above which they may describe one motion
_SIDES = re.compile(r"\b(left|right|clockwise|counter-?clockwise|anti-?clockwise)")


@dataclass(frozen=True)
class PairBatch:
    """Motions with one sentence each.

    Attributes:
        features: (B, T, D) de-normalised, zero beyond each length.
        lengths: (B,) frames, multiples of 4.
        text: (B, C) pooled features of the sentences.
        is_negative: (B, B), true where sentence and motion surely do not belong together.
    """

    features: Float[Tensor, "B T D"]
    lengths: Int[Tensor, "B"]
    text: Float[Tensor, "B C"]
    is_negative: Bool[Tensor, "B B"]


@dataclass(frozen=True)
class _Item:
    features: Float[Tensor, "T D"]
    captions: tuple[tuple[str, ...], ...]  # grouped by kind, so that a rare kind is not drowned
    twin: int | None  # the mirrored clip


class PairSampler:
    """Random crops with a random sentence, balanced over sources and over kinds of sentences.

    Whenever a clip is drawn, so is its mirrored twin: nothing else teaches left from right.

    Raises:
        ValueError: If no clip has a usable length and a caption of ``kinds``.
    """

    def __init__(
        self,
        clips: Sequence[FeatureClip],
        text_features: Mapping[str, Float[Tensor, "C"]],
        *,
        kinds: Collection[str] | None = None,
    ) -> None:
        self._text = text_features
        usable = {
            clip.id: clip for clip in clips if len(clip.features) >= MIN_FRAMES and _groups(clip, kinds)
        }
        if not usable:
            raise ValueError(f"No clip has {MIN_FRAMES} frames and a caption{_of(kinds)}.")
        place = {name: index for index, name in enumerate(usable)}
        self._items = [
            _Item(clip.features, _groups(clip, kinds), place.get(_twin_of(name)))
            for name, clip in usable.items()
        ]
        self._weights = source_weights([clip.source for clip in usable.values()], [1] * len(usable))

    def __len__(self) -> int:
        return len(self._items)

    def sample(self, count: int) -> PairBatch:
        """At most ``count`` pairs, half of them mirrored twins of the others, from torch's random state."""
        drawn = torch.multinomial(self._weights, (count + 1) // 2, replacement=True).tolist()
        twins = [self._items[index].twin for index in drawn]
        chosen = list(dict.fromkeys([*drawn, *(twin for twin in twins if twin is not None)]))
        return self.batch(chosen[:count])

    def shuffled(self, group: int) -> list[list[int]]:
        """All items once in random groups of ``group``; the rest is left out."""
        order: list[int] = torch.randperm(len(self)).tolist()
        return [order[first : first + group] for first in range(0, len(order) - group + 1, group)]

    def batch(self, indices: Sequence[int]) -> PairBatch:
        """A random crop and a random sentence of each of the items ``indices``."""
        crops, captions = [], []
        for index in indices:
            item = self._items[index]
            frames = min(len(item.features), MAX_FRAMES) // UNIT * UNIT
            start = int(torch.randint(len(item.features) - frames + 1, ()))
            crops.append(item.features[start : start + frames])
            kind = item.captions[int(torch.randint(len(item.captions), ()))]
            captions.append(kind[int(torch.randint(len(kind), ()))])
        text = torch.stack([self._text[caption] for caption in captions])
        return PairBatch(
            pad_sequence(crops, batch_first=True),
            torch.tensor([len(crop) for crop in crops]),
            text,
            sure_negatives(text, captions),
        )


def sure_negatives(text: Float[Tensor, "B C"], captions: Sequence[str]) -> Bool[Tensor, "B B"]:
    """Pairs of sentences that do not mean the same: little alike, or alike but for left and right.

    A batch holds several clips of one action; without this the right answer would count as a wrong one.
    """
    directions = torch.nn.functional.normalize(text, dim=-1)
    differs = directions @ directions.T < _SAME_MEANING
    sides = [frozenset(_SIDES.findall(caption.lower())) for caption in captions]
    swapped = torch.tensor([[bool(a and b and a != b) for b in sides] for a in sides])
    return (differs | swapped) & ~torch.eye(len(captions), dtype=torch.bool)


def _groups(clip: FeatureClip, kinds: Collection[str] | None) -> tuple[tuple[str, ...], ...]:
    found: dict[str, list[str]] = {}
    for caption in clip.captions:
        if not caption.is_partial and (kinds is None or caption.kind in kinds):
            found.setdefault(caption.kind, []).append(caption.text)
    return tuple(tuple(texts) for texts in found.values())


def _twin_of(name: str) -> str:
    return name[1:] if name.startswith("M") else f"M{name}"


def _of(kinds: Collection[str] | None) -> str:
    return "" if kinds is None else f" of the kinds {', '.join(sorted(kinds))}"
