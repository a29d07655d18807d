"""Body parts by name: the joints that are held when a part is kept as it is."""

from __future__ import annotations

import difflib

from controlmm.controls.checks import resolve_joint
from controlmm.motion.skeleton import HUMANML3D, Skeleton

# lower, upper, left_arm, right_arm, legs and spine are MaskControl's; the rest is ours.
PARTS: dict[str, tuple[str, ...]] = {
    "lower": ("pelvis", "left_foot", "right_foot"),
    "upper": ("head", "left_wrist", "right_wrist"),
    "left_arm": ("left_wrist", "left_elbow"),
    "right_arm": ("right_wrist", "right_elbow"),
    "arms": ("left_wrist", "left_elbow", "right_wrist", "right_elbow"),
    "left_leg": ("left_foot", "left_knee"),
    "right_leg": ("right_foot", "right_knee"),
    "legs": ("left_foot", "left_knee", "right_foot", "right_knee"),
    "spine": ("pelvis",),
    "body": HUMANML3D.joint_names,
}


def check_part(part: str) -> str:
    """The part, if it is one of :data:`PARTS` or a joint.

    Raises:
        TypeError: If it is no string.
        ValueError: If there is no such part; the message suggests the nearest.
    """
    if not isinstance(part, str):
        raise TypeError(f"`part` must be a name such as 'upper', got {type(part).__name__}.")
    if part in PARTS or part in HUMANML3D.joint_names:
        return part
    near = difflib.get_close_matches(
        part.lower().replace(" ", "_"), [*PARTS, *HUMANML3D.joint_names], n=1, cutoff=0.5
    )
    suggestion = f' Did you mean "{near[0]}"?' if near else ""
    raise ValueError(f'Unknown part "{part}".{suggestion} Parts: {", ".join(PARTS)}, or the name of a joint.')


def part_joints(part: str, skeleton: Skeleton) -> tuple[int, ...]:
    """Indices of the joints of a part, in rising order.

    Raises:
        ValueError: If the part is unknown, or the skeleton lacks one of its joints.
    """
    names = PARTS.get(check_part(part), (part,))
    return tuple(sorted(resolve_joint(name, skeleton) for name in names))
