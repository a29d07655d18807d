"""What TLControl's test-time optimisation adds to the control loss, so that feet do not slide.

Terms are functions of the joints, one value a clip, see :mod:`controlmm.generation.terms`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from controlmm.generation.clip_sums import clip_sums
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.resting_feet import in_contact, led_feet
from controlmm.motion.skeleton import Skeleton

_PUBLISHED_HEIGHT = 0.02  # metres: ankle and toe on average lower: the released code plants a foot


@dataclass(frozen=True, eq=False)
class ContactTerm:
    """Ours: half the mean squared horizontal step of the feet in frames in which they rest, m^2.

    Attributes:
        rests: (B, T, F) whether a foot joint rests from a frame to the next one; false behind a clip's end.
        joints: The ``F`` foot joints.
        weight: Factor.
    """

    rests: Bool[Tensor, "B T F"]
    joints: tuple[int, ...]
    weight: float = 1.0

    @classmethod
    def of_motion(
        cls,
        decoder: MotionDecoder,
        latents: Float[Tensor, "B L C"],
        frames: Bool[Tensor, "B T"],
        mask: Bool[Tensor, "B T J 3"],
        *,
        weight: float = 1.0,
    ) -> ContactTerm:
        """The term for the contacts that the decoder says ``latents`` have.

        A foot that has a target at a frame follows that alone; ``mask`` has the controlled coordinates.
        """
        skeleton = decoder.normalizer.skeleton
        features = decoder.clip_features(latents, frames)
        rests = in_contact(features, skeleton)
        free = frames[..., None] & ~led_feet(mask.any(-1), skeleton)
        rests[:, :-1] &= free[:, :-1] & free[:, 1:]  # a step has two frames
        rests[:, -1] = False
        return cls(rests, skeleton.foot_joints, weight)

    def values(self, joints: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B"]:
        """See :class:`JointTerm`."""
        feet = joints[:, :, list(self.joints)]
        steps = (feet[:, 1:] - feet[:, :-1])[..., [0, 2]].square().sum(-1)
        rests = self.rests[:, :-1]
        return self.weight * 0.5 * clip_sums(steps * rests) / rests.sum((1, 2)).clamp(min=1)

    def select(self, clips: Int[Tensor, " N"]) -> ContactTerm:
        """See :class:`JointTerm`."""
        return replace(self, rests=self.rests[clips])


@dataclass(frozen=True, eq=False)
class PublishedFootTerm:
    """The released code's: a foot that is low is held on the floor where it was last in the air.

    Kept for comparison. The ankle of a standing foot is several centimetres high, so that the term rarely
    acts, and where it does it pulls the ankle into the floor.

    Attributes:
        frames: (B, T) the frames of each clip.
        skeleton: Whose feet.
        weight: Factor.
    """

    frames: Bool[Tensor, "B T"]
    skeleton: Skeleton
    weight: float = 1.0

    def values(self, joints: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B"]:
        """See :class:`JointTerm`."""
        pairs = (self.skeleton.left_foot, self.skeleton.right_foot)
        losses = torch.stack([self._loss(joints[:, :, list(pair)]) for pair in pairs]).mean(0)
        return self.weight * clip_sums(losses * self.frames) / self.frames.sum(1)

    def select(self, clips: Int[Tensor, " N"]) -> PublishedFootTerm:
        """See :class:`JointTerm`."""
        return replace(self, frames=self.frames[clips])

    def _loss(self, feet: Float[Tensor, "B T 2 3"]) -> Float[Tensor, "B T"]:
        is_up = feet[..., 1].mean(2) > _PUBLISHED_HEIGHT / self.skeleton.metres
        at = torch.arange(feet.shape[1], device=feet.device).expand(is_up.shape)
        last_up = torch.where(is_up, at, 0).cummax(1).values  # frame 0 until a foot has been in the air
        remembered = feet.gather(1, last_up[..., None, None].expand(feet.shape))
        held = remembered * feet.new_tensor([1.0, 0.0, 1.0])
        target = torch.where(is_up[..., None, None], feet, held)
        return smooth_l1_loss(feet, target, reduction="none").mean((2, 3))
