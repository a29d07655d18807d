"""The closed end as a whole: project, restore the bones, refit the features, say what it cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.generation.exact.bones import restore_bones
from controlmm.generation.exact.projection import project_on_targets
from controlmm.generation.exact.refit import refit_features
from controlmm.generation.one_thread import one_thread
from controlmm.generation.side_by_side import side_by_side
from controlmm.generation.solvers import Progress
from controlmm.motion.features import bone_lengths
from controlmm.motion.layout import feature_layout
from controlmm.motion.skeleton import Skeleton
from controlmm.ops import recover_joints

_PLANTED_SPEED = 1.0  # metres a second; a foot in contact that is faster is no longer standing
_CONTACT = 0.5  # of the contact channels
_NOTHING = 1e-4  # of the skeleton's unit: a motion so near its targets, with such bones, stays as it is


@dataclass(frozen=True)
class ExactReport:
    """What the closed end did to one clip. Pairs are before and after.

    Attributes:
        residual: Largest distance of a controlled coordinate to its target, metres.
        bone_error: Largest difference of a bone from the skeleton's length, metres.
        jerk: Mean size of the third derivative of all joints, m/s^3.
        slide: Mean horizontal speed of planted feet, m/s.
    """

    residual: tuple[float, float]
    bone_error: tuple[float, float]
    jerk: tuple[float, float]
    slide: tuple[float, float]


@one_thread()
def meet_exactly(
    features: Float[Tensor, "T D"],
    targets: Float[Tensor, "T J 3"],
    mask: Bool[Tensor, "T J 3"],
    skeleton: Skeleton,
    *,
    bones: Float[Tensor, "J"] | None = None,
) -> tuple[Float[Tensor, "T D"], ExactReport]:
    """Features whose joints lie on the targets, changed least.

    Args:
        features: De-normalised, of an edited motion that is near its targets.
        targets: In the networks' frame, the skeleton's unit.
        mask: The controlled coordinates.
        skeleton: Its bone lengths are kept, where they are published; else those that the clip has on
            average.
        bones: Lengths to keep instead, of the bone from each joint to its parent.
    """
    joints = recover_joints(features[None].double(), joints=skeleton.num_joints)[0]
    targets = targets.double()
    lengths = _lengths(joints, skeleton) if bones is None else bones.double()
    planted = planted_feet(features, joints, skeleton)  # after as before

    def measured(clip: Tensor) -> _Measures:
        return _Measures(
            _residual(clip, targets, mask),
            _bone_error(clip, lengths, skeleton),
            _jerk(clip, skeleton),
            _slide(clip, planted, skeleton),
        )

    before = measured(joints)
    if before.residual <= _NOTHING and before.bone_error <= _NOTHING:
        return features, _report(before, before, skeleton)
    held = mask.clone()
    held[0, 0, [0, 2]] = True  # features begin with the root at x = z = 0
    wanted = torch.where(mask, targets, joints)
    moved = project_on_targets(joints, wanted, held, planted, skeleton)
    moved = restore_bones(moved, lengths, held, planted, skeleton)
    fitted = refit_features(features, moved, skeleton)
    after = recover_joints(fitted[None], joints=skeleton.num_joints)[0].double()
    return fitted, _report(before, measured(after), skeleton)


def all_meet_exactly(
    clips: Sequence[tuple[Float[Tensor, "T D"], Float[Tensor, "T J 3"], Bool[Tensor, "T J 3"]]],
    skeleton: Skeleton,
    *,
    bones: Float[Tensor, "J"] | None = None,
) -> list[tuple[Float[Tensor, "T D"], ExactReport]]:
    """:func:`meet_exactly` for (features, targets, mask) of several clips, side by side."""

    def meet(clip: int, _: Progress | None) -> tuple[Float[Tensor, "T D"], ExactReport]:
        return meet_exactly(*clips[clip], skeleton, bones=bones)

    return side_by_side([partial(meet, clip) for clip in range(len(clips))])


class _Measures(NamedTuple):
    """Of one motion, in the skeleton's unit; see :class:`ExactReport`."""

    residual: float
    bone_error: float
    jerk: float
    slide: float


def _report(before: _Measures, after: _Measures, skeleton: Skeleton) -> ExactReport:
    metres = skeleton.metres
    return ExactReport(*((metres * one, metres * other) for one, other in zip(before, after, strict=True)))


def planted_feet(
    features: Float[Tensor, "T D"], joints: Float[Tensor, "T J 3"], skeleton: Skeleton
) -> Bool[Tensor, "T J"]:
    """Joints of the feet that stand in a frame and the next: in contact, and slower than 1 m/s."""
    feet = skeleton.foot_joints
    in_contact = features[:, feature_layout(skeleton).foot_contacts] > _CONTACT
    speed = joints[:, feet][..., [0, 2]].diff(dim=0).norm(dim=-1) * skeleton.fps * skeleton.metres
    stands = in_contact[:-1] & in_contact[1:] & (speed < _PLANTED_SPEED)
    planted = torch.zeros(joints.shape[:2], dtype=torch.bool)
    planted[:-1, list(feet)] = stands
    return planted


def _lengths(joints: Float[Tensor, "T J 3"], skeleton: Skeleton) -> Float[Tensor, "J"]:
    if skeleton.bone_lengths is None:
        return bone_lengths(joints, skeleton).mean(0)
    lengths: Tensor = skeleton.rest_offsets().norm(dim=-1)
    return lengths


def _residual(joints: Tensor, targets: Tensor, mask: Tensor) -> float:
    return (joints - targets)[mask].abs().max().item() if mask.any() else 0.0


def _bone_error(joints: Tensor, lengths: Tensor, skeleton: Skeleton) -> float:
    error = (bone_lengths(joints, skeleton) - lengths)[:, 1:].abs().max()
    return float(error)


def _jerk(joints: Tensor, skeleton: Skeleton) -> float:
    return float((joints.diff(n=3, dim=0) * skeleton.fps**3).norm(dim=-1).mean())


def _slide(joints: Tensor, planted: Tensor, skeleton: Skeleton) -> float:
    step = joints[..., [0, 2]].diff(dim=0).norm(dim=-1)[planted[:-1]] * skeleton.fps
    return step.mean().item() if len(step) else 0.0
