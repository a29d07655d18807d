"""One recorded clip with its captions, as joints or as features."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Caption:
    """A sentence about a clip, or about a part of it."""

    text: str
    kind: str = "annotator"  # who wrote it: annotator, description, template, written, kinematic
    start: float = 0.0  # seconds; start = end = 0 means the whole clip
    end: float = 0.0

    @property
    def is_partial(self) -> bool:
        """Whether the sentence speaks of ``start`` to ``end`` only."""
        return self.end > self.start


@dataclass(frozen=True)
class Clip:
    """Joint positions of one clip: (F, J, 3) metres, Y up, at the skeleton's frame rate."""

    id: str
    joints: Float[Tensor, "F J 3"]
    captions: tuple[Caption, ...]
    source: str = "unknown"
    licence: str = "unknown"
    split: str = "train"


@dataclass(frozen=True)
class FeatureClip:
    """De-normalised features of one clip: (T, D)."""

    id: str
    features: Float[Tensor, "T D"]
    captions: tuple[Caption, ...]
    source: str = "unknown"
