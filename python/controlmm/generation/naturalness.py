"""What keeps an edited motion natural where no target says how it should move.

A distance to targets does not mind if the rest of the body shakes or a standing foot slides. These terms do.
They are sums over a clip in squared standard deviations of the codes, the unit in which editing measures its
steps, and compare with the motion that editing starts from, so that a lively motion stays lively.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import max_pool1d

from controlmm.generation.clip_sums import clip_sums
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.resting_feet import in_contact, led_feet
from controlmm.motion.skeleton import Skeleton
from controlmm.ops import recover_joints

_FLOOR_SECONDS = 0.5  # to each side: within it a foot touches the ground, unless a jump is high
_MEANT_CLIMB = 0.5  # metres: a start that climbs by more means to (stairs), and its floor is left alone
_VELOCITY, _JERK = 1, 3  # orders of differences in time


@dataclass(frozen=True)
class NaturalWeights:
    """How much each term counts.

    Attributes:
        nearness: Of the squared length of the whole step.
        steadiness: For each m^2 by which velocity and jerk of a joint in the body's frame change from a frame
            to the next, where no target leads the joint.
        feet: For each m^2 by which a foot at rest moves from a frame to the next.
        floor: For each m^2 of height of the lowest point of the second around a frame.
    """

    nearness: float = 0.005
    steadiness: float = 2.0
    feet: float = 40.0
    floor: float = 10.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"`{name}` must be a number of at least 0, got {value!r}.")

    def times(self, factor: float) -> NaturalWeights:
        """All terms weaker or stronger."""
        return NaturalWeights(**{name: factor * value for name, value in vars(self).items()})


@dataclass(frozen=True, eq=False)
class Naturalness:
    """The terms for clips of up to ``T`` frames; nearness is the solvers' business.

    Attributes:
        start: (B, T, D) root channels and joint positions that editing starts from, de-normalised.
        is_free: (B, T, J) no target leads the joint in this frame.
        rests: (B, T, F) whether a foot joint rests from this frame to the next.
        is_level: (B,) whether the lowest point should stay on the ground.
        frames: (B, T) of each clip.
        skeleton: Its joints.
        weights: Of the terms.
    """

    start: Float[Tensor, "B T D"]
    is_free: Bool[Tensor, "B T J"]
    rests: Bool[Tensor, "B T F"]
    is_level: Bool[Tensor, "B"]
    frames: Bool[Tensor, "B T"]
    skeleton: Skeleton
    weights: NaturalWeights

    @classmethod
    def of_start(
        cls,
        decoder: MotionDecoder,
        latents: Float[Tensor, "B L C"],
        mask: Bool[Tensor, "B T J 3"],
        frames: Bool[Tensor, "B T"],
        weights: NaturalWeights,
    ) -> Naturalness:
        """The terms for editing that starts from ``latents``, with targets where ``mask`` says.

        The floor is kept level where no height has a target, unless the start climbs by half a metre.
        """
        skeleton = decoder.normalizer.skeleton
        features = decoder.clip_features(latents, frames)
        joints = recover_joints(features, joints=skeleton.num_joints)
        is_led = mask.any(-1)
        floors = floor_heights(joints, frames, skeleton)
        climb = skeleton.metres * (floors.amax(1) - floors.amin(1))
        return cls(
            features[..., : 1 + 3 * skeleton.num_joints],
            ~is_led,
            _at_rest(features, is_led, frames, skeleton),
            ~mask[..., 1].flatten(1).any(1) & (climb < _MEANT_CLIMB),
            frames,
            skeleton,
            weights,
        )

    def values(
        self, features: Float[Tensor, "B T D"], joints: Float[Tensor, "B T J 3"]
    ) -> Float[Tensor, "B"]:
        """Half the weighted sums of each clip.

        Args:
            features: Root channels and joint positions as they are now, de-normalised.
            joints: What they decode to, in the skeleton's unit.
        """
        weights = self.weights
        value = weights.steadiness * self._unsteadiness(features) + weights.feet * self._sliding(joints)
        if self.is_level.any():
            value = value + weights.floor * self._unevenness(joints)
        return 0.5 * self.skeleton.metres**2 * value

    def select(self, clips: Int[Tensor, " N"]) -> Naturalness:
        """The same for some of the clips."""
        fields = ("start", "is_free", "rests", "is_level", "frames")
        return replace(self, **{name: getattr(self, name)[clips] for name in fields})

    def _unsteadiness(self, features: Float[Tensor, "B T D"]) -> Float[Tensor, "B"]:
        """Also counts the jerk of the root's way: second differences of its velocity."""
        change = features - self.start
        places = nn.functional.pad(change[..., 3:], (2, 0)).unflatten(-1, (-1, 3))  # the root: its height
        way = change[..., None, 1:3]
        total = features.new_zeros(len(features))
        for moved, order, is_free in (
            (places, _VELOCITY, self.is_free),
            (places, _JERK, self.is_free),
            (way, _JERK - 1, self.is_free[..., :1]),
        ):
            spans, inside = (x.unfold(1, order + 1, 1) for x in (is_free, self.frames))
            counts = spans.any(-1) & inside.all(-1)[..., None]  # where all frames are led, targets decide
            total = total + clip_sums(moved.diff(n=order, dim=1).square().sum(-1) * counts)
        return total

    def _sliding(self, joints: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B"]:
        steps = joints[:, :, list(self.skeleton.foot_joints)].diff(dim=1).square().sum(-1)
        return clip_sums(steps * self.rests[:, :-1])

    def _unevenness(self, joints: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B"]:
        """Of motions that will be stood on the floor: heights count from the clip's lowest point."""
        floors = floor_heights(joints, self.frames, self.skeleton)
        lowest = floors.where(self.frames, torch.inf).amin(1, keepdim=True)
        return clip_sums((floors - lowest).square() * self.frames) * self.is_level


def floor_heights(
    joints: Float[Tensor, "B T J 3"], frames: Bool[Tensor, "B T"], skeleton: Skeleton
) -> Float[Tensor, "B T"]:
    """Height of the lowest joint of the second around each frame; in padding that of the clip's end."""
    reach = round(_FLOOR_SECONDS * skeleton.fps)
    lowest = joints[..., 1].amin(-1).where(frames, torch.inf)
    pooled = -max_pool1d(-lowest[:, None], 2 * reach + 1, stride=1, padding=reach)[:, 0]
    end = pooled.gather(1, frames.sum(1, keepdim=True) - 1)
    heights: Tensor = pooled.where(frames, end)
    return heights


def _at_rest(
    features: Float[Tensor, "B T D"],
    is_led: Bool[Tensor, "B T J"],
    frames: Bool[Tensor, "B T"],
    skeleton: Skeleton,
) -> Bool[Tensor, "B T F"]:
    """Joints of feet without targets that the contact channels say rest in a frame and the next."""
    stands = in_contact(features, skeleton) & ~led_feet(is_led, skeleton) & frames[..., None]
    rests = torch.zeros_like(stands)
    rests[:, :-1] = stands[:, :-1] & stands[:, 1:]
    return rests
