"""Token sequences of all clips with their captions: what the three transformers are trained on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from tqdm import tqdm

from controlmm.data.clip import FEWEST_FRAMES, MOST_FRAMES, Caption, FeatureClip
from controlmm.models.rvq_vae import frame_mask
from controlmm.models.tokenizer import MotionTokenizer
from controlmm.motion.normalizer import Normalizer
from controlmm.training.windows import source_weights

_ENCODE_BATCH = 64
_DROP_UNIT = 1 / 3  # share of samples that are one token shorter than they could be
_LONGEST = 196
_LENGTH_BAND = 0.15  # the clips of a batch differ from the first in length by at most this share


@dataclass(frozen=True)
class TokenBatch:
    """A batch of clips as tokens, padded to the longest."""

    ids: Int[Tensor, "B L Q"]  # -1 in padding
    valid: Bool[Tensor, "B L"]
    features: Float[Tensor, "B T D"]  # normalised, zero in padding
    text: Float[Tensor, "B E"]
    captions: list[str]

    def to(self, device: torch.device) -> TokenBatch:
        """The same batch on another device."""
        return TokenBatch(
            self.ids.to(device),
            self.valid.to(device),
            self.features.to(device),
            self.text.to(device),
            self.captions,
        )

    @property
    def frames(self) -> Bool[Tensor, "B T"]:
        """Frames that belong to each clip."""
        return self.valid.repeat_interleave(self.features.shape[1] // self.valid.shape[1], dim=1)


@dataclass(frozen=True)
class _Item:
    clip: int
    start: int  # frames of the clip that the captions speak of
    end: int
    captions: tuple[tuple[str, ...], ...]  # grouped by kind, so that a rare kind is not drowned


class TokenSampler:
    """Random crops of tokenised clips with a random caption.

    A clip is tokenised once at each of its four frame offsets, so a crop may begin at any frame.

    Raises:
        ValueError: If no clip has a usable length and a caption.
    """

    def __init__(
        self,
        clips: Sequence[FeatureClip],
        normalizer: Normalizer,
        tokenizer: MotionTokenizer,
        text_features: Mapping[str, Float[Tensor, "E"]],
        *,
        progress: bool = True,
        min_frames: int = FEWEST_FRAMES["m"],
    ) -> None:
        self.downsample = tokenizer.config.downsample
        self._features = [normalizer.normalize(clip.features) for clip in clips]
        self._text = text_features
        fps = normalizer.skeleton.fps
        self._items = [
            item
            for index, clip in enumerate(clips)
            for item in _items_of(index, clip, fps, min_frames=min_frames)
        ]
        if not self._items:
            raise ValueError(
                f"No clip of a split has a caption and {min_frames} to {MOST_FRAMES} frames, which this "
                "stage is trained and validated on. Add captions, and cut long clips into pieces."
            )
        self._ids = tokenize(self._features, tokenizer, progress=progress)
        sources = [clips[item.clip].source for item in self._items]
        self._weights = source_weights(sources, [1] * len(self._items))
        self._frames = torch.tensor([item.end - item.start for item in self._items])

    def __len__(self) -> int:
        return len(self._items)

    def sample(self, count: int) -> TokenBatch:
        """``count`` random crops of about the same length, from torch's global random state."""
        chosen = near_lengths(self._frames, self._weights, count)
        return self._collate([self._random_crop(self._items[index]) for index in chosen])

    def whole(self, indices: Sequence[int]) -> TokenBatch:
        """Items ``indices`` uncropped with their first caption: for validation."""
        crops = []
        for index in indices:
            item = self._items[index]
            tokens = min(item.end - item.start, _LONGEST) // self.downsample
            crops.append((item, item.start, tokens, item.captions[0][0]))
        return self._collate(crops)

    def _random_crop(self, item: _Item) -> tuple[_Item, int, int, str]:
        frames = min(item.end - item.start, _LONGEST)
        tokens = frames // self.downsample
        if torch.rand(()) < _DROP_UNIT:
            tokens -= 1
        slack = item.end - item.start - tokens * self.downsample
        start = item.start + int(torch.randint(slack + 1, ()))
        kind = item.captions[int(torch.randint(len(item.captions), ()))]
        return item, start, tokens, kind[int(torch.randint(len(kind), ()))]

    def _collate(self, crops: list[tuple[_Item, int, int, str]]) -> TokenBatch:
        ids, features, captions = [], [], []
        for item, start, tokens, caption in crops:
            offset, first = start % self.downsample, start // self.downsample
            ids.append(self._ids[item.clip][offset][first : first + tokens].long())
            features.append(self._features[item.clip][start : start + tokens * self.downsample])
            captions.append(caption)
        padded = pad_sequence(ids, batch_first=True, padding_value=-1)
        return TokenBatch(
            padded,
            frame_mask(torch.tensor([len(x) for x in ids]), padded.shape[1]),
            pad_sequence(features, batch_first=True),
            torch.stack([self._text[caption] for caption in captions]),
            captions,
        )


def _items_of(index: int, clip: FeatureClip, fps: float, *, min_frames: int) -> list[_Item]:
    """The clip with its whole-clip captions, and one item for every caption about a part of it."""
    items = []
    whole = [caption for caption in clip.captions if not caption.is_partial]
    if whole and min_frames <= len(clip.features) <= MOST_FRAMES:
        items.append(_Item(index, 0, len(clip.features), _by_kind(whole)))
    for caption in clip.captions:
        start, end = int(caption.start * fps), min(int(caption.end * fps), len(clip.features))
        if caption.is_partial and min_frames <= end - start <= MOST_FRAMES:
            items.append(_Item(index, start, end, ((caption.text,),)))
    return items


def _by_kind(captions: Sequence[Caption]) -> tuple[tuple[str, ...], ...]:
    kinds: dict[str, list[str]] = {}
    for caption in captions:
        kinds.setdefault(caption.kind, []).append(caption.text)
    return tuple(tuple(texts) for texts in kinds.values())


def near_lengths(lengths: Int[Tensor, "N"], weights: Float[Tensor, "N"], count: int) -> list[int]:
    """``count`` random indices (with replacement) of items of about the same length.

    A first item is drawn freely and the others near its length, which keeps every item's share nearly as it
    was and spends little on padding.
    """
    first = lengths[torch.multinomial(weights, 1)]
    is_near = (lengths - first).abs() <= _LENGTH_BAND * first
    chosen: list[int] = torch.multinomial(weights * is_near, count, replacement=True).tolist()
    return chosen


@torch.no_grad()
def tokenize(
    features: Sequence[Float[Tensor, "T D"]], tokenizer: MotionTokenizer, *, progress: bool
) -> list[list[Int[Tensor, "L Q"]]]:
    """Ids of every clip at every frame offset. Similar lengths go together, so little is spent on padding."""
    tokenizer.eval()
    step = tokenizer.config.downsample
    ids: list[list[Tensor]] = [[torch.empty(0)] * step for _ in features]
    order = sorted(range(len(features)), key=lambda i: len(features[i]))
    for first in tqdm(range(0, len(order), _ENCODE_BATCH), desc="tokenising", disable=not progress):
        batch = order[first : first + _ENCODE_BATCH]
        for offset in range(step):
            crops = [features[i][offset : offset + (len(features[i]) - offset) // step * step] for i in batch]
            lengths = torch.tensor([len(crop) for crop in crops])
            padded = pad_sequence(crops, batch_first=True)
            encoded = tokenizer.encode(padded, frame_mask(lengths, padded.shape[1])).short()
            for i, clip_ids, length in zip(batch, encoded, lengths.tolist(), strict=True):
                ids[i][offset] = clip_ids[: length // step].clone()
    return ids
