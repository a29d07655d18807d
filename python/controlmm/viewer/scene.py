"""What a picture shows: a motion in metres, and the control targets with their distance to the joints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from controlmm.controls import Avoid, TimelineEntry
from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import Skeleton


@dataclass(frozen=True)
class Scene:
    """A motion made ready to be drawn.

    Attributes:
        skeleton: Names and hierarchy of the joints.
        fps: Frames per second.
        text: The prompt.
        joints: (T, J, 3) metres, Y up.
        targets: (T, J, 3) metres; free coordinates take the joint's own, so a ground path is drawn at the
            height where the joint went.
        is_asked: (T, J, 3) coordinates that a control asked for.
        obstacles: What joints kept out of, metres.
        timeline: What each body part does when.
    """

    skeleton: Skeleton
    fps: float
    text: str
    joints: Float[ndarray, "T J 3"]
    targets: Float[ndarray, "T J 3"]
    is_asked: Bool[ndarray, "T J 3"]
    obstacles: tuple[Avoid, ...] = ()
    timeline: tuple[TimelineEntry, ...] = ()

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.joints)

    @property
    def is_controlled(self) -> Bool[ndarray, "T J"]:
        """Whether a joint has a target at a frame."""
        result: ndarray = np.asarray(self.is_asked.any(-1))
        return result

    @property
    def distances(self) -> Float[ndarray, "T J"]:
        """Distance of each joint to its target in metres over the coordinates asked for; 0 without target."""
        result: ndarray = np.linalg.norm(self.targets - self.joints, axis=-1)
        return result

    def controlled_joints(self) -> list[int]:
        """Joints with a target, those controlled at the most frames first."""
        counts = self.is_controlled.sum(0)
        return [int(joint) for joint in np.argsort(-counts, kind="stable") if counts[joint]]

    def control_error(self) -> float | None:
        """Mean distance to the targets in metres, ``None`` without targets."""
        return float(self.distances[self.is_controlled].mean()) if self.is_controlled.any() else None


def scene_of(motion: Motion, *, targets: Any = None, mask: Any = None) -> Scene:
    """Scene of a motion with the targets given, or else those in ``motion.extra``.

    Obstacles and timeline are taken from ``motion.extra``.

    Args:
        motion: HumanML3D or KIT-ML motion.
        targets: (T, J, 3) in the skeleton's unit, tensor or array; where ``mask`` is false ignored.
        mask: (T, J, 3) or (T, J) bool, the coordinates asked for.

    Raises:
        ValueError: If only one of the two is there, a shape is wrong, or an asked target is not finite.
    """
    if targets is None and mask is None:
        targets, mask = motion.extra.get("targets"), motion.extra.get("mask")
    if (targets is None) != (mask is None):
        raise ValueError("`targets` and `mask` belong together: pass both or neither.")
    unit = 0.001 if motion.skeleton.unit == "mm" else 1.0
    joints = motion.joints.detach().cpu().double().numpy() * unit
    if targets is None:
        wanted, is_asked = joints, np.zeros(joints.shape, dtype=bool)
    else:
        wanted, is_asked = _checked(targets, mask, joints.shape)
        wanted = np.where(is_asked, wanted * unit, joints)
    return Scene(
        skeleton=motion.skeleton, fps=motion.fps, text=motion.text, joints=joints,
        targets=wanted, is_asked=is_asked,
        obstacles=tuple(motion.extra.get("obstacles", ())), timeline=tuple(motion.extra.get("timeline", ())),
    )  # fmt: skip


def _checked(targets: Any, mask: Any, shape: tuple[int, ...]) -> tuple[ndarray, ndarray]:
    wanted = np.asarray(targets, dtype=np.float64)
    is_asked = np.asarray(mask)
    if wanted.shape != shape:
        raise ValueError(f"`targets` must have shape {shape}, as the joints have, got {wanted.shape}.")
    if is_asked.dtype != bool or is_asked.shape not in (shape, shape[:2]):
        raise ValueError(
            f"`mask` must be bool of shape {shape} or {shape[:2]}, got {is_asked.dtype} {is_asked.shape}."
        )
    if is_asked.ndim == 2:
        is_asked = np.repeat(is_asked[..., None], 3, axis=-1)
    if not np.isfinite(wanted[is_asked]).all():
        raise ValueError("`targets` must be finite wherever `mask` is true, got NaN or infinity.")
    return wanted, is_asked
