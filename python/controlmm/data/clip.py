"""One recorded clip with its captions, as joints or as features."""

from __future__ import annotations

import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

SPLITS = ("train", "val", "test")
# Frames of the clips that transformers are trained and judged on, by the skeleton's unit (KIT-ML: 12.5 fps).
FEWEST_FRAMES = {"m": 40, "mm": 24}
MOST_FRAMES = 199


@dataclass(frozen=True)
class Caption:
    """A sentence about a clip, or about a part of it."""

    text: str
    kind: str = "annotator"  # who wrote it: annotator, description, template, written, kinematic
    start: float = 0.0  # seconds; start = end = 0 means the whole clip
    end: float = 0.0
    tokens: tuple[
        str, ...
    ] = ()  # ``word/TAG``, where the data set has them; the published evaluator needs them

    @property
    def is_partial(self) -> bool:
        """Whether the sentence speaks of ``start`` to ``end`` only."""
        return self.end > self.start


def parse_caption(line: str, kind: str = "annotator") -> Caption:
    """A line ``sentence#word/TAG ...#start#end`` of a text file; no or NaN times mean the whole clip."""
    text, *rest = line.split("#")
    times = []
    for value in rest[1:3]:
        try:
            times.append(float(value))
        except ValueError:
            times.append(0.0)
    start, end = times if len(times) == 2 and all(map(math.isfinite, times)) else (0.0, 0.0)
    tokens = tuple(rest[0].split()) if rest else ()
    return Caption(text.strip(), kind, start, end, tokens)


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
