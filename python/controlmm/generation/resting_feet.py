"""Which feet stand, as the decoder's contact channels say, and which ones the targets lead."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.motion.layout import feature_layout
from controlmm.motion.skeleton import Skeleton

_IS_CONTACT = 0.5  # of a contact channel, which is 1 at rest and 0 in motion


def in_contact(features: Float[Tensor, "B T D"], skeleton: Skeleton) -> Bool[Tensor, "B T F"]:
    """Whether each foot joint of de-normalised features stands in a frame."""
    return features[..., feature_layout(skeleton).foot_contacts] > _IS_CONTACT


def led_feet(is_led: Bool[Tensor, "B T J"], skeleton: Skeleton) -> Bool[Tensor, "B T F"]:
    """For each foot joint, whether a joint of its foot has a target in a frame."""
    feet = (skeleton.left_foot, skeleton.right_foot)
    led = torch.stack([is_led[:, :, list(foot)].any(-1) for foot in feet], dim=-1)
    return led.repeat_interleave(2, dim=-1)
