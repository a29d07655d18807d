"""The six body parts of TLControl: which joints and which feature channels belong to each.

Source: Wan et al., TLControl, ECCV 2024. Every feature channel belongs to exactly one part.
"""

from __future__ import annotations

from dataclasses import dataclass

from controlmm.motion.layout import FeatureLayout, feature_layout
from controlmm.motion.skeleton import Skeleton

PART_NAMES = ("root", "trunk", "left_arm", "right_arm", "left_leg", "right_leg")
_JOINTS = {
    "humanml3d": (
        (0,), (3, 6, 9, 12, 15), (13, 16, 18, 20), (14, 17, 19, 21), (1, 4, 7, 10), (2, 5, 8, 11),
    ),
    # Not published. The joints at +X after processing are the left ones, whatever MMM's names say.
    "kit": ((0,), (1, 2, 3, 4), (8, 9, 10), (5, 6, 7), (16, 17, 18, 19, 20), (11, 12, 13, 14, 15)),
}  # fmt: skip


@dataclass(frozen=True)
class BodyPart:
    """A part with its joints, from the body outwards, and its feature channels in the published order."""

    name: str
    joints: tuple[int, ...]
    channels: tuple[int, ...]  # joint by joint position, rotation, velocity; extras last

    @property
    def trajectory_joint(self) -> int:
        """The joint whose trajectory steers the part: its outermost one."""
        return self.joints[-1]


def body_parts(skeleton: Skeleton) -> tuple[BodyPart, ...]:
    """Root, trunk with head, left arm, right arm, left leg, right leg: the order of codes and codebooks."""
    layout = feature_layout(skeleton)
    contacts = layout.foot_contacts.start
    extras = {"left_leg": (contacts, contacts + 1), "right_leg": (contacts + 2, contacts + 3)}
    return tuple(
        BodyPart(name, joints, _channels(joints, layout) + extras.get(name, ()))
        for name, joints in zip(PART_NAMES, _JOINTS[skeleton.name], strict=True)
    )


def trajectory_joints(skeleton: Skeleton) -> tuple[int, ...]:
    """The six joints that trajectories are given for, in the order of the parts."""
    return tuple(part.trajectory_joint for part in body_parts(skeleton))


def part_index(name: str) -> int:
    """Number of a part.

    Raises:
        ValueError: If there is no part of that name; the message lists them.
    """
    if name not in PART_NAMES:
        raise ValueError(f"Unknown body part {name!r}. Use one of: {', '.join(PART_NAMES)}.")
    return PART_NAMES.index(name)


def _channels(joints: tuple[int, ...], layout: FeatureLayout) -> tuple[int, ...]:
    channels: list[int] = []
    for joint in joints:
        if joint == 0:  # the root has no local position or rotation, but the four channels that move it
            channels += range(layout.root_height.stop)
        else:
            channels += _of_joint(layout.local_positions, joint - 1, 3)
            channels += _of_joint(layout.local_rotations, joint - 1, 6)
        channels += _of_joint(layout.joint_velocities, joint, 3)
    return tuple(channels)


def _of_joint(group: slice, index: int, width: int) -> range:
    return range(group.start + width * index, group.start + width * (index + 1))
