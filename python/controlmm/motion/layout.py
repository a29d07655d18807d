"""Named slices of the HumanML3D (263) and KIT-ML (251) feature vectors."""

from __future__ import annotations

from dataclasses import dataclass

from controlmm.motion.skeleton import Skeleton


@dataclass(frozen=True)
class FeatureLayout:
    """Where each group of channels lies in a frame of features. Inside a group the layout is joint-major."""

    root_yaw_velocity: slice  # half the yaw change to the next frame, radians
    root_velocity: slice  # x, z displacement of the root to the next frame, in the next frame's heading
    root_height: slice  # y of the root
    local_positions: slice  # joints 1..J-1: x, z relative to the root in its heading, y absolute ("ric")
    local_rotations: slice  # joints 1..J-1: 6D rotations relative to the parent
    joint_velocities: slice  # joints 0..J-1: displacement to the next frame, in this frame's heading
    foot_contacts: slice  # left ankle, left toe, right ankle, right toe: 1 when at rest

    @property
    def groups(self) -> tuple[slice, ...]:
        """The seven groups in channel order; each shares one standard deviation."""
        return (
            self.root_yaw_velocity,
            self.root_velocity,
            self.root_height,
            self.local_positions,
            self.local_rotations,
            self.joint_velocities,
            self.foot_contacts,
        )


def feature_layout(skeleton: Skeleton) -> FeatureLayout:
    """The layout of ``skeleton``'s features, ``12 J - 1`` wide."""
    joints = skeleton.num_joints
    sizes = (1, 2, 1, 3 * (joints - 1), 6 * (joints - 1), 3 * joints, 4)
    starts = [sum(sizes[:i]) for i in range(len(sizes))]
    return FeatureLayout(*(slice(start, start + size) for start, size in zip(starts, sizes, strict=True)))
