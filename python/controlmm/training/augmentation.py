"""More training clips out of the recorded ones: joined pairs, other speeds, bent ways. All off by default."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.data.clip import FeatureClip
from controlmm.motion.features import joints_to_features
from controlmm.motion.skeleton import skeleton_of_width
from controlmm.ops import recover_joints
from controlmm.training.caption_truth import joined_captions, true_at_other_speed, true_on_bent_way
from controlmm.training.motion_changes import BLEND_FRAMES, along_bent_way, at_speed, joined, pose_distance

_SPEEDS = 0.8, 1.25
_SMALLEST_BEND = 25.0  # degrees in all, to either side
_SHORTEST_WAY = 1.5  # metres that a clip must cover to be bent
_NARROWEST = 1.0  # metres: radius of the tightest bend
_CANDIDATES = 24  # second clips that are tried for a first one
_NEAR_POSES = 0.12  # metres; poses further apart are not joined
_LONGEST, _SHORTEST = 196, 40  # frames of a new clip
_TRIES = 20  # for each clip that is asked for, before it is given up

_Change = Callable[[Sequence[FeatureClip], torch.Generator], FeatureClip | None]


@dataclass(frozen=True)
class Augmentation:
    """Clips to add, as shares of the number of recorded training clips."""

    joined_share: float = 0.0  # two clips in a row at matching poses, "..., then ..."
    speed_share: float = 0.0  # 0.8 to 1.25 times as fast
    bent_share: float = 0.0  # ways bent by 25 degrees or more
    largest_bend: float = 75.0  # degrees; never so many that the radius falls under a metre
    augmentation_seed: int = 0

    def __post_init__(self) -> None:
        for name in ("joined_share", "speed_share", "bent_share"):
            if not 0 <= getattr(self, name) <= 10:
                raise ValueError(f"`{name}` must be between 0 and 10, got {getattr(self, name)}.")
        if not _SMALLEST_BEND <= self.largest_bend <= 720:
            raise ValueError(f"`largest_bend` must be between 25 and 720 degrees, got {self.largest_bend}.")


def augmented(clips: Sequence[FeatureClip], augmentation: Augmentation) -> list[FeatureClip]:
    """New clips, made of ``clips``, with the captions that are still true of them; the same for a seed.

    Fewer than asked for when too few clips suit. Features are computed anew from the changed joints.
    """
    made: list[FeatureClip] = []
    generator = torch.Generator().manual_seed(augmentation.augmentation_seed)
    bend = partial(_bend, largest=augmentation.largest_bend)
    for share, make in (
        (augmentation.joined_share, _join),
        (augmentation.speed_share, _hasten),
        (augmentation.bent_share, bend),
    ):
        made += _some(clips, round(share * len(clips)), make, generator)
    return made


def _some(
    clips: Sequence[FeatureClip], count: int, make: _Change, generator: torch.Generator
) -> list[FeatureClip]:
    """``count`` clips that ``make`` makes, each of other random ones; ``make`` may decline."""
    made: list[FeatureClip] = []
    for _ in range(_TRIES * count if clips else 0):
        if len(made) == count:
            break
        clip = make(clips, generator)
        if clip is not None:
            made.append(dataclasses.replace(clip, id=f"{clip.id}~{len(made)}"))
    return made


def _join(clips: Sequence[FeatureClip], generator: torch.Generator) -> FeatureClip | None:
    """A random clip, and of some others the one whose beginning is nearest to its end."""
    first = _draw(clips, generator)
    room = _LONGEST + BLEND_FRAMES - len(first.features)
    others = [_draw(clips, generator) for _ in range(_CANDIDATES)]
    others = [other for other in others if BLEND_FRAMES <= len(other.features) <= room]
    if len(first.features) < BLEND_FRAMES or not others:
        return None
    before = _joints(first)
    distances = [pose_distance(before, _joints(other)) for other in others]
    second = others[distances.index(min(distances))]
    captions = joined_captions(first.captions, second.captions)
    if min(distances) * _metres(first) > _NEAR_POSES or not captions:
        return None
    name = f"{first.id}+{second.id}"
    return FeatureClip(name, _features(joined(before, _joints(second))), captions, first.source)


def _hasten(clips: Sequence[FeatureClip], generator: torch.Generator) -> FeatureClip | None:
    clip = _draw(clips, generator)
    factor = _uniform(*_SPEEDS, generator)
    captions = true_at_other_speed(clip.captions)
    if not captions or not _SHORTEST <= len(clip.features) / factor <= _LONGEST:
        return None
    return FeatureClip(
        f"{clip.id}*{factor:.2f}", _features(at_speed(_joints(clip), factor)), captions, clip.source
    )


def _bend(clips: Sequence[FeatureClip], generator: torch.Generator, *, largest: float) -> FeatureClip | None:
    clip = _draw(clips, generator)
    joints = _joints(clip)
    way = float((joints[-1, 0] - joints[0, 0])[[0, 2]].norm()) * _metres(clip)
    most = min(largest, math.degrees(way / _NARROWEST))
    side = 1 if torch.rand((), generator=generator) < 0.5 else -1
    degrees = side * _uniform(_SMALLEST_BEND, most, generator)
    captions = true_on_bent_way(clip.captions)
    if not captions or way < _SHORTEST_WAY:
        return None
    return FeatureClip(
        f"{clip.id}@{degrees:+.0f}", _features(along_bent_way(joints, degrees)), captions, clip.source
    )


def _draw(clips: Sequence[FeatureClip], generator: torch.Generator) -> FeatureClip:
    return clips[int(torch.randint(len(clips), (), generator=generator))]


def _uniform(low: float, high: float, generator: torch.Generator) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator))


def _joints(clip: FeatureClip) -> Float[Tensor, "T J 3"]:
    skeleton = skeleton_of_width(clip.features.shape[1])
    return recover_joints(clip.features[None].double(), joints=skeleton.num_joints)[0]


def _features(joints: Float[Tensor, "F J 3"]) -> Float[Tensor, "T D"]:
    """Features of joints that are set down with frame 0 at the origin; heights are kept."""
    start = joints[0, 0] * joints.new_tensor([1, 0, 1])
    return joints_to_features(joints - start, public_quirks=False)


def _metres(clip: FeatureClip) -> float:
    return skeleton_of_width(clip.features.shape[1]).metres
