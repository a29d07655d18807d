"""A motion that is edited: its features, where it stands in the world, and what of it is kept."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.controls import part_joints, yaw_matrix
from controlmm.motion.features import canonicalize, joints_to_features
from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import Skeleton
from controlmm.ops import recover_joints
from controlmm.pipelines.checks import MIN_FRAMES

Interval = tuple[float, float]  # seconds
_ALIGNED = 0.005  # degrees: less than a millimetre over ten metres


@dataclass(frozen=True, eq=False)
class SourceMotion:
    """A motion in the networks' frame, with the way back to its own world.

    Attributes:
        features: (T, D) de-normalised.
        joints: (T, J, 3) in the networks' frame.
        yaw: Degrees about Y from the networks' frame to the world.
        offset: (3,) from the turned networks' frame to the world.
    """

    features: Float[Tensor, "T D"]
    joints: Float[Tensor, "T J 3"]
    yaw: float
    offset: Float[Tensor, "3"]

    @classmethod
    def of(cls, motion: Motion, *, skeleton: Skeleton, max_frames: int) -> SourceMotion:
        """The motion made ready; features are made from its joints if it carries none.

        Raises:
            TypeError: If it is no motion.
            ValueError: If it has another skeleton, or too few or too many frames.
        """
        if not isinstance(motion, Motion):
            raise TypeError(
                f"`motion` must be a Motion, got {type(motion).__name__}. Read a file with Motion.load."
            )
        if motion.skeleton.name != skeleton.name:
            raise ValueError(f"`motion` must have the {skeleton.name} skeleton, got {motion.skeleton.name}.")
        if not MIN_FRAMES <= motion.num_frames <= max_frames:
            raise ValueError(
                f"`motion` must have {MIN_FRAMES} to {max_frames} frames, "
                f"got {motion.num_frames}. Cut it first."
            )
        features = motion.features if motion.features is not None else _features_of(motion.joints)
        joints = recover_joints(features[None], joints=skeleton.num_joints)[0]
        yaw = _yaw_between(joints[0], motion.joints[0])
        turned = cls(features, joints, yaw, torch.zeros(3))
        return dataclasses.replace(turned, offset=(motion.joints[0] - turned.placed(joints[0])).mean(0))

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.joints)

    @property
    def turn(self) -> Float[Tensor, "3 3"]:
        """From the networks' frame to the world."""
        return torch.eye(3) if self.is_aligned else yaw_matrix(self.yaw)

    @property
    def is_aligned(self) -> bool:
        """Whether both frames have the same axes, as in motions that a pipeline made."""
        return abs(self.yaw) < _ALIGNED

    def placed(self, joints: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        """Points of the networks' frame in the world of the motion."""
        return joints @ self.turn.T + self.offset

    def unplaced(self, points: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        """Points of the world in the networks' frame."""
        return (points - self.offset) @ self.turn


def kept_coordinates(
    source: SourceMotion, keep: Sequence[Interval], keep_parts: Sequence[str], skeleton: Skeleton
) -> Bool[Tensor, "T J"]:
    """Joints and frames that stay as they are: whole poses in intervals, and parts at all frames.

    Raises:
        TypeError: If ``keep`` or ``keep_parts`` is no list.
        ValueError: If an interval lies outside the motion, a part is unknown, or nothing is left to change.
    """
    kept = torch.zeros(source.num_frames, skeleton.num_joints, dtype=torch.bool)
    kept[kept_frames(source.num_frames, keep, skeleton.fps)] = True
    if isinstance(keep_parts, str):
        raise TypeError(f"`keep_parts` must be a list of parts, got {keep_parts!r}. Pass [{keep_parts!r}].")
    for part in keep_parts:
        kept[:, list(part_joints(part, skeleton))] = True
    if kept.all():
        raise ValueError("`keep` and `keep_parts` keep everything, so there is nothing to change.")
    return kept


def kept_frames(frames: int, keep: Sequence[Interval], fps: float) -> Bool[Tensor, "T"]:
    """True at the frames of the intervals, which are seconds, start included, end not.

    Raises:
        TypeError: If ``keep`` is no list of pairs.
        ValueError: If an interval is empty or lies outside the motion.
    """
    kept = torch.zeros(frames, dtype=torch.bool)
    if isinstance(keep, str) or not isinstance(keep, Sequence):
        raise TypeError(f"`keep` must be a list of (start, end) in seconds, got {type(keep).__name__}.")
    for index, interval in enumerate(keep):
        is_pair = isinstance(interval, Sequence) and len(interval) == 2
        if not is_pair or not all(isinstance(s, Real) and math.isfinite(s) for s in interval):
            raise TypeError(f"`keep[{index}]` must be (start, end) in seconds, got {interval!r}.")
        start, end = (round(second * fps) for second in interval)
        if not 0 <= start < end <= frames:
            raise ValueError(
                f"`keep[{index}]` must lie within the motion, 0 to {frames / fps:g} s, start before end, "
                f"got {interval[0]:g} to {interval[1]:g}."
            )
        kept[start:end] = True
    return kept


def _features_of(joints: Float[Tensor, "T J 3"]) -> Float[Tensor, "T D"]:
    """As many frames of features as of joints: the last step is repeated, since each needs a next one."""
    longer = torch.cat([joints, 2 * joints[-1:] - joints[-2:-1]])
    return joints_to_features(canonicalize(longer))


def _yaw_between(source: Float[Tensor, "J 3"], target: Float[Tensor, "J 3"]) -> float:
    """Degrees about Y that turn ``source`` best onto ``target`` (least squares over the ground plane)."""
    a, b = ((points - points.mean(0)).double()[:, [0, 2]] for points in (source, target))
    across = (a[:, 1] * b[:, 0] - a[:, 0] * b[:, 1]).sum()
    along = (a * b).sum()
    return math.degrees(math.atan2(float(across), float(along)))
