"""The two skeletons of the field: HumanML3D (22 joints, metres) and KIT-ML (21 joints, millimetres).

Right-handed frame, Y up; the body faces +Z at frame 0 and its left is +X.
Source: HumanML3D (Guo et al., CVPR 2022) and its public processing scripts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_X, _Y, _Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
_NEG_X, _NEG_Y = (-1, 0, 0), (0, -1, 0)


@dataclass(frozen=True)
class Skeleton:
    """Joint names, hierarchy and processing constants of one motion representation."""

    name: str
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]  # -1 for the root
    chains: tuple[tuple[int, ...], ...]  # order matters: inverse and forward kinematics walk them in turn
    directions: tuple[tuple[int, int, int], ...]  # unit vector parent -> joint in the rest pose
    bone_lengths: tuple[float, ...] | None  # of the reference body, in `unit`; None: not published
    mirror: tuple[int, ...]  # joint that takes a joint's place when left and right are swapped
    facing: tuple[int, int, int, int]  # right hip, left hip, right shoulder, left shoulder
    left_foot: tuple[int, int]  # ankle, toe
    right_foot: tuple[int, int]
    leg_bones: tuple[int, int]  # the two bones whose lengths set the scale when retargeting
    contact_threshold: float  # squared displacement of a frame below which a foot rests, unit^2
    control_joints: tuple[int, ...]  # the six joints of the papers' control experiments
    fps: float
    unit: str

    @property
    def num_joints(self) -> int:
        """Number of joints ``J``."""
        return len(self.joint_names)

    @property
    def feature_dim(self) -> int:
        """Width ``D = 12 J - 1`` of one frame of features."""
        return 12 * self.num_joints - 1

    @property
    def metres(self) -> float:
        """Length of one ``unit`` in metres."""
        return 0.001 if self.unit == "mm" else 1.0

    @property
    def foot_joints(self) -> tuple[int, int, int, int]:
        """The joints of the four contact channels, in channel order."""
        return (*self.left_foot, *self.right_foot)

    def rest_offsets(self) -> Float[Tensor, "J 3"]:
        """Offset of every joint from its parent in the rest pose (T-pose), in ``unit``; zero for the root.

        Raises:
            ValueError: If the skeleton's bone lengths are not published (KIT-ML).
        """
        if self.bone_lengths is None:
            raise ValueError(
                f"The reference bone lengths of skeleton {self.name!r} are not published. "
                "Measure them on a clip with `bone_lengths(joints, skeleton)`."
            )
        lengths = torch.tensor(self.bone_lengths, dtype=torch.float64)
        return torch.tensor(self.directions, dtype=torch.float64) * lengths[:, None]

    def joint_index(self, joint: str | int) -> int:
        """Index of a joint given by name (``"left_wrist"``) or index.

        Raises:
            ValueError: If the skeleton has no such joint; the message lists the names.
        """
        if isinstance(joint, str):
            if joint in self.joint_names:
                return self.joint_names.index(joint)
            raise ValueError(
                f"Unknown joint {joint!r}. The {self.name} skeleton has: {', '.join(self.joint_names)}."
            )
        if not 0 <= joint < self.num_joints:
            raise ValueError(f"Joint index must be in 0..{self.num_joints - 1}, got {joint}.")
        return joint


def _mirror_of(pairs: Sequence[tuple[int, int]], count: int) -> tuple[int, ...]:
    order = list(range(count))
    for left, right in pairs:
        order[left], order[right] = right, left
    return tuple(order)


HUMANML3D = Skeleton(
    name="humanml3d",
    joint_names=(
        "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
        "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head",
        "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
    ),
    parents=(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19),
    chains=(
        (0, 2, 5, 8, 11), (0, 1, 4, 7, 10), (0, 3, 6, 9, 12, 15), (9, 14, 17, 19, 21), (9, 13, 16, 18, 20),
    ),
    directions=(
        (0, 0, 0), _X, _NEG_X, _Y, _NEG_Y, _NEG_Y, _Y, _NEG_Y, _NEG_Y, _Y, _Z, _Z, _Y, _X, _NEG_X, _Z,
        _NEG_Y, _NEG_Y, _NEG_Y, _NEG_Y, _NEG_Y, _NEG_Y,
    ),
    bone_lengths=(
        0.0, 0.10307, 0.10988, 0.13157, 0.39362, 0.39019, 0.14319, 0.43243, 0.42564, 0.05736, 0.14338,
        0.14942, 0.21936, 0.13749, 0.14338, 0.10304, 0.13161, 0.12298, 0.25684, 0.26309, 0.26601, 0.26988,
    ),
    mirror=_mirror_of(((1, 2), (4, 5), (7, 8), (10, 11), (13, 14), (16, 17), (18, 19), (20, 21)), 22),
    facing=(2, 1, 17, 16),
    left_foot=(7, 10),
    right_foot=(8, 11),
    leg_bones=(5, 8),
    contact_threshold=0.002,
    control_joints=(0, 10, 11, 15, 20, 21),
    fps=20.0,
    unit="m",
)  # fmt: skip

# The names of MMM call 5-7 and 11-15 left, the feature code treats them as right (they lie at -X). Address
# KIT joints by index, never by side.
KIT = Skeleton(
    name="kit",
    joint_names=(
        "root", "BP", "BT", "BLN", "BUN", "LS", "LE", "LW", "RS", "RE", "RW", "LH", "LK", "LA", "LMrot", "LF",
        "RH", "RK", "RA", "RMrot", "RF",
    ),
    parents=(-1, 0, 1, 2, 3, 3, 5, 6, 3, 8, 9, 0, 11, 12, 13, 14, 0, 16, 17, 18, 19),
    chains=((0, 11, 12, 13, 14, 15), (0, 16, 17, 18, 19, 20), (0, 1, 2, 3, 4), (3, 5, 6, 7), (3, 8, 9, 10)),
    directions=(
        (0, 0, 0), _Y, _Y, _Y, _Y, _X, _NEG_Y, _NEG_Y, _NEG_X, _NEG_Y, _NEG_Y, _X, _NEG_Y, _NEG_Y, _Z, _Z,
        _NEG_X, _NEG_Y, _NEG_Y, _Z, _Z,
    ),
    bone_lengths=None,
    mirror=_mirror_of(((5, 8), (6, 9), (7, 10), (11, 16), (12, 17), (13, 18), (14, 19), (15, 20)), 21),
    facing=(11, 16, 5, 8),
    left_foot=(19, 20),
    right_foot=(14, 15),
    leg_bones=(17, 18),
    contact_threshold=0.05,
    control_joints=(0, 4, 7, 10, 15, 20),
    fps=12.5,
    unit="mm",
)  # fmt: skip

SKELETONS = {skeleton.name: skeleton for skeleton in (HUMANML3D, KIT)}


def skeleton_of_width(feature_dim: int) -> Skeleton:
    """The skeleton whose features are ``feature_dim`` wide (263 or 251).

    Raises:
        ValueError: If no skeleton has that width.
    """
    for skeleton in SKELETONS.values():
        if skeleton.feature_dim == feature_dim:
            return skeleton
    raise ValueError(
        "Features must be 263 wide (HumanML3D, 22 joints) or 251 wide (KIT-ML, 21 joints), "
        f"got {feature_dim}."
    )


def skeleton_of_joints(num_joints: int) -> Skeleton:
    """The skeleton with ``num_joints`` joints (22 or 21).

    Raises:
        ValueError: If no skeleton has that many joints.
    """
    for skeleton in SKELETONS.values():
        if skeleton.num_joints == num_joints:
            return skeleton
    raise ValueError(f"Joints must number 22 (HumanML3D) or 21 (KIT-ML), got {num_joints}.")
