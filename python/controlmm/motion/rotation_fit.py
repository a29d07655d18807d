"""Rigid-bone rotations fitted to joint positions, for files that store rotations (BVH).

The rotation channels of HumanML3D's features do not give the decoded pose (they come from another kinematic
tree), so rotations are always fitted to the positions. Decoded bones are not quite rigid either: the fit says
how far its joints lie from the given ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.motion.rotations import quat_conjugate, quat_multiply, quat_rotate
from controlmm.motion.skeleton import HUMANML3D, Skeleton
from controlmm.motion.t_pose import (
    arm_chains,
    branching_joints,
    children_of,
    leg_chains,
    t_pose_offsets,
    trunk_chain,
)
from controlmm.motion.twist import aim, unit_or
from controlmm.motion.wahba import best_rotation

BoneLengths = Literal["clip", "reference"]

# Share of the foot's direction in what a leg takes for "front": decides only while the knee is straight.
_FOOT_SHARE = 0.3


@dataclass(frozen=True)
class RotationFit:
    """A motion of rigid bones.

    Attributes:
        skeleton: Names and hierarchy of the joints.
        offsets: (J, 3) offset of every joint from its parent in the T-pose, in the skeleton's unit.
        root_positions: (T, 3) global position of the root, exactly the given one.
        local_rotations: (T, J, 4) unit quaternions ``(w, x, y, z)`` relative to the parent (the root's: to
            the world), identity in the T-pose. Neighbouring frames lie in one hemisphere.
        joints: (T, J, 3) global positions that these rotations give.
        errors: (T, J) distance of ``joints`` from the positions that were fitted, in the skeleton's unit.
    """

    skeleton: Skeleton
    offsets: Float[Tensor, "J 3"]
    root_positions: Float[Tensor, "T 3"]
    local_rotations: Float[Tensor, "T J 4"]
    joints: Float[Tensor, "T J 3"]
    errors: Float[Tensor, "T J"]

    @property
    def mean_error(self) -> float:
        """Mean distance between fitted and given joints, in the skeleton's unit."""
        return float(self.errors.mean())

    @property
    def max_error(self) -> float:
        """Largest distance between a fitted and a given joint, in the skeleton's unit."""
        return float(self.errors.max())


def fit_rotations(
    joints: Float[Tensor, "T J 3"], skeleton: Skeleton = HUMANML3D, *, bone_lengths: BoneLengths = "clip"
) -> RotationFit:
    """Fit a rigid skeleton, resting in a T-pose, to joint positions.

    The pelvis and the chest take the rotation that carries all their bones best; every other joint aims its
    bone from the *fitted* joint at the given child, so that errors do not add up along a limb. Limbs twist
    with the plane of their elbow or knee.

    Args:
        joints: Global positions in the skeleton's unit, Y up.
        skeleton: HumanML3D (22 joints) or KIT-ML (21 joints).
        bone_lengths: ``"clip"`` takes each bone's mean length over the clip, ``"reference"`` the skeleton's.

    Returns:
        The fit in float64, with the distance to the given joints.

    Raises:
        ValueError: If the shape is wrong, a value is not finite, or ``bone_lengths`` is unknown.
    """
    targets = _checked(joints, skeleton)
    offsets = t_pose_offsets(targets, skeleton, lengths=_lengths(targets, skeleton, bone_lengths))
    rotations, fitted = _fit_outwards(targets, offsets, skeleton)
    return RotationFit(
        skeleton=skeleton,
        offsets=offsets,
        root_positions=targets[:, 0],
        local_rotations=_local_rotations(rotations, skeleton),
        joints=fitted,
        errors=(fitted - targets).norm(dim=-1),
    )


def _checked(joints: Float[Tensor, "T J 3"], skeleton: Skeleton) -> Float[Tensor, "T J 3"]:
    if joints.ndim != 3 or tuple(joints.shape[1:]) != (skeleton.num_joints, 3) or len(joints) == 0:
        raise ValueError(
            f"`joints` must have shape (T, {skeleton.num_joints}, 3) with T >= 1 for the {skeleton.name} "
            f"skeleton, got {tuple(joints.shape)}."
        )
    if not torch.isfinite(joints).all():
        raise ValueError("`joints` must be finite, got NaN or infinity.")
    return joints.detach().to("cpu", torch.float64)


def _lengths(targets: Float[Tensor, "T J 3"], skeleton: Skeleton, source: BoneLengths) -> Float[Tensor, "J"]:
    if source == "reference":
        reference: Tensor = skeleton.rest_offsets().norm(dim=-1)
        return reference
    if source != "clip":
        raise ValueError(f"`bone_lengths` must be 'clip' or 'reference', got {source!r}.")
    lengths = targets.new_zeros(skeleton.num_joints)
    lengths[1:] = (targets[:, 1:] - targets[:, list(skeleton.parents[1:])]).norm(dim=-1).mean(0)
    return lengths


def _fit_outwards(
    targets: Float[Tensor, "T J 3"], offsets: Float[Tensor, "J 3"], skeleton: Skeleton
) -> tuple[list[Float[Tensor, "T 4"]], Float[Tensor, "T J 3"]]:
    """Global rotation and position of every joint, root first; a leaf turns with its parent."""
    identity = targets.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(targets), 4)
    bends = _trunk_bends(targets, offsets, skeleton, identity)
    poles = _poles(targets, skeleton)
    rotations: list[Tensor] = []
    positions: list[Tensor] = []
    for joint, parent in enumerate(skeleton.parents):
        base = identity if parent < 0 else rotations[parent]
        positions.append(
            targets[:, 0] if parent < 0 else positions[parent] + quat_rotate(base, offsets[joint])
        )
        children = list(children_of(joint, skeleton))
        bones = targets[:, children] - positions[joint][:, None]
        if len(children) > 1:
            rotations.append(best_rotation(offsets[children], bones, prior=base))
        elif children:
            rest = unit_or(offsets[children], offsets.new_tensor([0.0, 1.0, 0.0]))[0]
            rotations.append(aim(bends.get(joint, base), rest, bones[:, 0], front=poles.get(joint)))
        else:
            rotations.append(base)
    return rotations, torch.stack(positions, dim=1)


def _trunk_bends(
    targets: Float[Tensor, "T J 3"],
    offsets: Float[Tensor, "J 3"],
    skeleton: Skeleton,
    identity: Float[Tensor, "T 4"],
) -> dict[int, Float[Tensor, "T 4"]]:
    """Where the spine joints start from: evenly between pelvis and chest, so that they share the twist."""
    pelvis, chest = branching_joints(skeleton)
    ends: list[Tensor] = []
    for joint in (pelvis, chest):
        children = list(children_of(joint, skeleton))
        prior = ends[-1] if ends else identity
        ends.append(best_rotation(offsets[children], targets[:, children] - targets[:, [joint]], prior=prior))
    spine = trunk_chain(skeleton)
    inner = spine[spine.index(pelvis) + 1 : spine.index(chest)]
    shares = {joint: (i + 1) / (len(inner) + 1) for i, joint in enumerate(inner)}
    return {joint: _between(ends[0], ends[1], share) for joint, share in shares.items()}


def _between(start: Float[Tensor, "T 4"], end: Float[Tensor, "T 4"], share: float) -> Float[Tensor, "T 4"]:
    """Normalised linear interpolation of quaternions of one hemisphere."""
    mixed = (1 - share) * start + share * end
    result: Tensor = mixed / mixed.norm(dim=-1, keepdim=True)
    return result


def _poles(targets: Float[Tensor, "T J 3"], skeleton: Skeleton) -> dict[int, Float[Tensor, "T 3"]]:
    """For each upper arm and thigh, where its front turns: to the inside of the elbow, to the knee cap."""
    zero = targets.new_zeros(3)
    poles = {}
    for chain in arm_chains(skeleton):
        shoulder, elbow, wrist = chain[-3:]
        poles[shoulder] = unit_or(targets[:, wrist] - targets[:, elbow], zero)
    for chain in leg_chains(skeleton):
        hip, knee, ankle, toe = *chain[1:4], chain[-1]
        foot = unit_or(targets[:, toe] - targets[:, ankle], zero)
        poles[hip] = _FOOT_SHARE * foot - unit_or(targets[:, ankle] - targets[:, knee], zero)
    return poles


def _local_rotations(rotations: list[Float[Tensor, "T 4"]], skeleton: Skeleton) -> Float[Tensor, "T J 4"]:
    """Rotations relative to the parent, with signs chosen so that neighbouring frames are near each other."""
    local = rotations[:1] + [
        quat_multiply(quat_conjugate(rotations[parent]), rotations[joint])
        for joint, parent in enumerate(skeleton.parents)
        if parent >= 0
    ]
    quats = torch.stack(local, dim=1)
    quats = quats / quats.norm(dim=-1, keepdim=True)
    flips = torch.where((quats[1:] * quats[:-1]).sum(-1) < 0, -1.0, 1.0).to(quats.dtype).cumprod(0)
    return torch.cat([quats[:1], quats[1:] * flips[..., None]])
