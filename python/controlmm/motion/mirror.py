"""Swapping left and right in joints, features and words. HumanML3D doubles its data so."""

from __future__ import annotations

import re

from jaxtyping import Float
from torch import Tensor

from controlmm.motion.layout import feature_layout
from controlmm.motion.skeleton import skeleton_of_joints, skeleton_of_width

_SUFFIXES = ("", "hand", "ward", "wards", "most", "y", "handed", "side", "s")
_SWAPS = {f"left{suffix}": f"right{suffix}" for suffix in _SUFFIXES}
_SWAPS |= {right: left for left, right in _SWAPS.items()}
_SWAPS |= {
    "clockwise": "counterclockwise",
    "counterclockwise": "clockwise",
    "counter-clockwise": "clockwise",
    "anticlockwise": "clockwise",
    "anti-clockwise": "clockwise",
}
_KEPT_PHRASES = (
    "right away", "right angles", "right angle", "all right", "right side up", "right now",
    "left over", "left off", "energy left", "strength left", "time left", "nothing left",
)  # fmt: skip
# Phrases come first, so that "right away" is taken whole before its "right" is seen.
_WORDS = re.compile(
    r"(?<![\w-])("
    + "|".join([*map(re.escape, _KEPT_PHRASES), *sorted(_SWAPS, key=len, reverse=True)])
    + r")(?![\w])"
)


def mirror_text(text: str) -> str:
    """``text`` in lower case, left and right, clockwise and counterclockwise swapped ("right away" stays)."""
    return _WORDS.sub(lambda match: _SWAPS.get(match[0], match[0]), text.lower())


def mirror_joints(joints: Float[Tensor, "*T J 3"]) -> Float[Tensor, "*T J 3"]:
    """The motion reflected at the plane x = 0, with left and right joints swapped."""
    order = list(skeleton_of_joints(joints.shape[-2]).mirror)
    return joints[..., order, :] * joints.new_tensor([-1, 1, 1])


def mirror_features(features: Float[Tensor, "*T D"]) -> Float[Tensor, "*T D"]:
    """De-normalised features of the reflected motion.

    Exact when no retargeting follows; HumanML3D's own mirrored clips differ slightly, since its reference
    body is not symmetric.
    """
    skeleton = skeleton_of_width(features.shape[-1])
    layout = feature_layout(skeleton)
    order = list(skeleton.mirror)
    body = [joint - 1 for joint in order[1:]]
    mirrored = features.clone()
    mirrored[..., layout.root_yaw_velocity] *= -1
    mirrored[..., layout.root_velocity] *= features.new_tensor([-1, 1])
    for group, joint_order, signs in (
        (layout.local_positions, body, (-1, 1, 1)),
        (layout.local_rotations, body, (1, -1, -1, -1, 1, 1)),
        (layout.joint_velocities, order, (-1, 1, 1)),
        (layout.foot_contacts, [1, 0], (1, 1)),
    ):
        values = features[..., group].unflatten(-1, (-1, len(signs)))
        mirrored[..., group] = (values[..., joint_order, :] * features.new_tensor(signs)).flatten(-2)
    return mirrored
