"""What is evaluated: clips with captions, by the rules of the public data loaders.

Source: Guo et al., CVPR 2022 (loader of the text-to-motion evaluation), MaskControl's public evaluation.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.data import Caption, FeatureClip, MotionFolder, read_packs
from controlmm.data.clip import FEWEST_FRAMES, MOST_FRAMES
from controlmm.data.packs import CAPTIONS_FILE
from controlmm.evaluation.random_streams import draw, stream
from controlmm.motion.features import joints_to_features
from controlmm.motion.skeleton import Skeleton, skeleton_of_width

MAX_FRAMES, UNIT = 196, 4
SCORED_KINDS = ("annotator", "written", "kinematic")  # templates of test occur in train too
ALL = "all"  # the split that is every clip
_TAG_FPS = 20  # times of captions are turned into frames with it, for KIT-ML's 12.5 fps too


@dataclass(frozen=True)
class Item:
    """A clip, or the part of one that a caption speaks of, with the captions that it may be given."""

    id: str
    features: Float[Tensor, "T D"]
    captions: tuple[Caption, ...]
    source: str


@dataclass(frozen=True)
class Sample:
    """An item as one repeat sees it: a crop of whole tokens and one caption."""

    id: str
    features: Float[Tensor, "m D"]
    caption: Caption
    source: str

    @property
    def length(self) -> int:
        """Frames ``m``, a multiple of 4."""
        return len(self.features)


@dataclass(frozen=True)
class TestSet:
    """All items of a split, with what a table says about them."""

    __test__ = False  # pytest: no test case, in spite of its name

    items: tuple[Item, ...]
    split: str
    kinds: tuple[str, ...]

    @property
    def skeleton(self) -> Skeleton:
        """The skeleton of all items."""
        return skeleton_of_width(self.items[0].features.shape[1])

    @property
    def sources(self) -> dict[str, int]:
        """Items of each source."""
        return dict(Counter(item.source for item in self.items))

    @property
    def sha256(self) -> str:
        """Of names, features and captions: equal sets have equal hashes."""
        digest = hashlib.sha256()
        for item in self.items:
            digest.update(item.id.encode())
            digest.update(item.features.numpy().tobytes())
            digest.update("\n".join(caption.text for caption in item.captions).encode())
        return digest.hexdigest()

    def samples(self, *, seed: int, repeat: int, draw_name: str = "crop") -> list[Sample]:
        """Every item once, in the random order of ``repeat``, with the crop and the caption of that repeat.

        Args:
            seed: Of the evaluation.
            repeat: 0, 1, ...
            draw_name: Another name gives other crops and captions in the same order.
        """
        order = torch.randperm(len(self.items), generator=stream(seed, repeat, "order"))
        chosen = (self.items[index] for index in order.tolist())
        return [sample_of(item, stream(seed, repeat, item.id, draw_name)) for item in chosen]


def sample_of(item: Item, generator: torch.Generator) -> Sample:
    """A random caption and a random crop, with probability 1/3 one token shorter than it could be."""
    caption = item.captions[draw(len(item.captions), generator)]
    frames = min(len(item.features), MAX_FRAMES + UNIT - 1)
    shorter = draw(3, generator) == 0
    length = (frames // UNIT - shorter) * UNIT
    start = draw(len(item.features) - length + 1, generator)
    return Sample(item.id, item.features[start : start + length], caption, item.source)


def read_test_set(
    data: str | Path,
    *,
    split: str = "test",
    kinds: Collection[str] = SCORED_KINDS,
    sources: Collection[str] | None = None,
) -> TestSet:
    """Items of a HumanML3D / KIT-ML folder, or of npz packs (their clips as they stand, not mirrored).

    Args:
        data: The folder; packs are known by their ``captions.jsonl``.
        split: ``train``, ``val``, ``test``; ``all`` takes every clip.
        kinds: Kinds of captions to use. Folders without kinds count as ``annotator``.
        sources: Take only clips of these sources; ``None`` takes all.

    Raises:
        FileNotFoundError: If the folder, or the list of the split, is missing.
        ValueError: If no clip has a usable length and a caption of ``kinds``.
    """
    clips = _read_clips(Path(data), split, sources)
    items = tuple(item for clip in clips for item in items_of(clip, kinds))
    if not items:
        of = "" if sources is None else f" of {', '.join(sources)}"
        raise ValueError(
            f"No clip{of} in the split {split!r} of {data} has 40 to 199 frames (KIT-ML: from 24) and a "
            f"caption of the kinds {', '.join(kinds)}. Choose other `--captions`, `--split` or `--sources`."
        )
    return TestSet(items, split, tuple(kinds))


def items_of(clip: FeatureClip, kinds: Collection[str]) -> Iterator[Item]:
    """The clip with all captions about the whole of it, and an item for each caption about a part."""
    shortest = FEWEST_FRAMES[skeleton_of_width(clip.features.shape[1]).unit]
    captions = [caption for caption in clip.captions if caption.kind in kinds]
    whole = tuple(caption for caption in captions if not caption.is_partial)
    if whole and shortest <= len(clip.features) <= MOST_FRAMES:
        yield Item(clip.id, clip.features, whole, clip.source)
    for number, caption in enumerate(captions):
        part = clip.features[int(caption.start * _TAG_FPS) : int(caption.end * _TAG_FPS)]
        if caption.is_partial and shortest <= len(part) <= MOST_FRAMES:
            yield Item(f"{clip.id}@{number}", part, (caption,), clip.source)


def _read_clips(data: Path, split: str, sources: Collection[str] | None) -> Iterator[FeatureClip]:
    if not (data / CAPTIONS_FILE).is_file():
        clips = MotionFolder(data).clips(split)
        yield from (clip for clip in clips if sources is None or clip.source in sources)
        return
    for clip in read_packs(data, sources=sources):
        if split in (ALL, clip.split):
            features = joints_to_features(clip.joints).float()
            yield FeatureClip(clip.id, features, clip.captions, clip.source)
