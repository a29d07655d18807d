"""Joint positions -> features: the HumanML3D / KIT-ML representation (Guo et al., CVPR 2022).

The way back is :func:`controlmm.ops.recover_joints`. Facing directions are computed in float64, quaternions
in float32, as the public scripts do; that is what makes released feature files agree to 1e-5.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.motion.rotations import (
    matrix_to_rot6d,
    quat_between,
    quat_conjugate,
    quat_multiply,
    quat_rotate,
    quat_to_matrix,
)
from controlmm.motion.skeleton import Skeleton, skeleton_of_joints

FACING_SIGMA = 20.0  # frames; the facing is smoothed so that the root does not follow every hip sway
_GAUSSIAN_TRUNCATE = 4.0


def joints_to_features(joints: Float[Tensor, "F J 3"], *, public_quirks: bool = True) -> Float[Tensor, "T D"]:
    """Features of canonical joints: ``T = F - 1`` frames of ``D = 12 J - 1`` numbers, float32.

    Args:
        joints: Global positions in metres (KIT-ML: millimetres), Y up, frame 0 at x = z = 0 and facing +Z, as
            :func:`canonicalize` returns them. 22 joints (HumanML3D) or 21 (KIT-ML).
        public_quirks: Keep the two defects of the public scripts, which released files hold: the first
            frame's heading is forced to +Z, so the yaw jumps by up to 40 degrees to frame 1, and the yaw
            velocity has the wrong sign where the heading passes 180 degrees. ``False`` turns the clip so that
            its smoothed heading starts at +Z and measures every turn rightly.

    Raises:
        ValueError: If the shape is wrong, there are fewer than 2 frames, or a facing direction or bone
            rotation is undefined (coinciding hips and shoulders, a bone turned exactly by 180 degrees).
    """
    skeleton = _checked_skeleton(joints, minimum_frames=2)
    joints = joints.double()
    heading = _heading(_smooth(_forward(joints, skeleton)))  # (F, 4) float32
    if public_quirks:
        heading[0] = heading.new_tensor([1, 0, 0, 0])
    else:
        joints = quat_rotate(heading[0].double(), joints)
        heading = quat_multiply(heading, quat_conjugate(heading[0]))
        heading = heading * heading.square().sum(-1, keepdim=True).rsqrt()

    step = (joints[1:] - joints[:-1]).float()  # (T, J, 3)
    joints = joints.float()
    turn = quat_multiply(heading[1:], quat_conjugate(heading[:-1]))  # (T, 4)
    yaw_velocity = _half_angle(turn, keep_wrap=public_quirks)[:, None]
    root_velocity = quat_rotate(heading[1:], step[:, 0])[:, [0, 2]]

    here = heading[:-1, None]  # (T, 1, 4)
    on_ground = joints[:-1, :1] * joints.new_tensor([1, 0, 1])
    local_positions = quat_rotate(here, joints[:-1, 1:] - on_ground).flatten(1)
    rotations = inverse_kinematics(joints, heading, skeleton)[:-1, 1:]
    joint_velocities = quat_rotate(here, step).flatten(1)
    feet = step[:, skeleton.foot_joints]
    contacts = (feet.square().sum(-1) < skeleton.contact_threshold).float()

    groups = [yaw_velocity, root_velocity, joints[:-1, 0, 1:2], local_positions]
    groups += [matrix_to_rot6d(quat_to_matrix(rotations)).flatten(1), joint_velocities, contacts]
    features = torch.cat(groups, dim=-1)
    _check_defined(features)
    return features


def canonicalize(joints: Float[Tensor, "F J 3"]) -> Float[Tensor, "F J 3"]:
    """The clip moved so that its lowest joint touches y = 0 and frame 0 stands at x = z = 0, facing +Z.

    Raises:
        ValueError: If the shape is wrong, or hips and shoulders of frame 0 coincide so that it faces nowhere.
    """
    skeleton = _checked_skeleton(joints, minimum_frames=1)
    joints = joints.double()
    joints = joints - joints[..., 1].min() * joints.new_tensor([0, 1, 0])
    joints = joints - joints[0, 0] * joints.new_tensor([1, 0, 1])
    right_hip, left_hip, right_shoulder, left_shoulder = skeleton.facing
    across = joints[0, right_hip] - joints[0, left_hip] + joints[0, right_shoulder] - joints[0, left_shoulder]
    forward = torch.linalg.cross(joints.new_tensor([0, 1, 0]), across)
    if not forward.norm() > 0:
        raise ValueError(
            "Frame 0 faces nowhere: the left and right hips and shoulders coincide seen from above."
        )
    return quat_rotate(_heading(forward), joints.float())


def retarget(joints: Float[Tensor, "F J 3"], target_offsets: Float[Tensor, "J 3"]) -> Float[Tensor, "F J 3"]:
    """The same motion on the reference body: its bone lengths, and the root path scaled by leg length.

    Args:
        joints: Any placement and heading; the bone lengths of frame 0 count as the source body's.
        target_offsets: Rest-pose offsets of the target, :meth:`Skeleton.rest_offsets`.

    Raises:
        ValueError: If the shape is wrong, a leg has no length, or a facing direction or bone rotation is
            undefined.
    """
    skeleton = _checked_skeleton(joints, minimum_frames=1)
    joints, target_offsets = joints.double(), target_offsets.double()
    upper, lower = skeleton.leg_bones
    source = bone_lengths(joints[:1], skeleton)[0]
    leg = source[upper] + source[lower]
    if not leg > 0:
        raise ValueError("The legs of frame 0 have no length; check the joint order.")
    largest = target_offsets.abs().amax(-1)
    scale = (largest[upper] + largest[lower]) / leg
    root_path = (joints[:, 0] * scale).float()
    heading = _heading(_forward(joints, skeleton))
    heading[0] = heading.new_tensor([1, 0, 0, 0])
    rotations = inverse_kinematics(joints.float(), heading, skeleton)
    retargeted = forward_kinematics(rotations, root_path, target_offsets.float(), skeleton)
    _check_defined(retargeted.flatten(1))
    return retargeted


def bone_lengths(joints: Float[Tensor, "F J 3"], skeleton: Skeleton) -> Float[Tensor, "F J"]:
    """Distance of every joint to its parent; 0 for the root."""
    parents = list(skeleton.parents)
    parents[0] = 0
    lengths: Tensor = (joints - joints[:, parents]).norm(dim=-1)
    return lengths


def inverse_kinematics(
    joints: Float[Tensor, "F J 3"], heading: Float[Tensor, "F 4"], skeleton: Skeleton
) -> Float[Tensor, "F J 4"]:
    """Local rotation of every joint; the root's is the heading. Twist about the bone is not represented.

    Every chain, also the arms that branch off the spine, starts again from the heading.
    """
    directions = torch.tensor(skeleton.directions, dtype=joints.dtype)
    rotations = heading[:, None].repeat(1, skeleton.num_joints, 1)
    for chain in skeleton.chains:
        current = heading
        for parent, child in pairwise(chain):
            bone = joints[:, child] - joints[:, parent]
            bone = bone / bone.norm(dim=-1, keepdim=True)
            turned = quat_between(directions[child].expand_as(bone), bone)
            rotations[:, child] = quat_multiply(quat_conjugate(current), turned)
            current = quat_multiply(current, rotations[:, child])
    return rotations


def forward_kinematics(
    rotations: Float[Tensor, "F J 4"],
    root_path: Float[Tensor, "F 3"],
    offsets: Float[Tensor, "J 3"],
    skeleton: Skeleton,
) -> Float[Tensor, "F J 3"]:
    """Joint positions of local ``rotations``, the inverse of :func:`inverse_kinematics`."""
    positions = root_path[:, None].repeat(1, skeleton.num_joints, 1)
    for chain in skeleton.chains:
        current = rotations[:, 0]
        for parent, child in pairwise(chain):
            current = quat_multiply(current, rotations[:, child])
            positions[:, child] = positions[:, parent] + quat_rotate(current, offsets[child])
    return positions


def _checked_skeleton(joints: Tensor, *, minimum_frames: int) -> Skeleton:
    if joints.ndim != 3 or joints.shape[-1] != 3 or len(joints) < minimum_frames:
        raise ValueError(
            f"`joints` must have shape (F, 22, 3) or (F, 21, 3) with F >= {minimum_frames}, "
            f"got {tuple(joints.shape)}."
        )
    if not torch.isfinite(joints).all():
        raise ValueError("`joints` must be finite, found NaN or infinity.")
    return skeleton_of_joints(joints.shape[1])


def _check_defined(values: Float[Tensor, "F N"]) -> None:
    undefined = (~torch.isfinite(values)).any(1)
    if undefined.any():
        raise ValueError(
            f"The pose of frame {int(undefined.nonzero()[0])} has no defined rotations (coinciding joints or "
            "a bone turned by exactly 180 degrees). Leave the clip out or move its joints a little."
        )


def _forward(joints: Float[Tensor, "F J 3"], skeleton: Skeleton) -> Float[Tensor, "F 3"]:
    # Hips and shoulders enter with opposite signs, unlike in `canonicalize`: so do the public scripts.
    right_hip, left_hip, right_shoulder, left_shoulder = skeleton.facing
    across = joints[:, left_hip] - joints[:, right_hip] + joints[:, right_shoulder] - joints[:, left_shoulder]
    across = across / across.norm(dim=-1, keepdim=True)
    _check_defined(across)  # here, since smoothing would blame the frames around
    forward: Tensor = torch.linalg.cross(joints.new_tensor([0, 1, 0]).expand_as(across), across, dim=-1)
    return forward


def _smooth(forward: Float[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    radius = int(_GAUSSIAN_TRUNCATE * FACING_SIGMA + 0.5)
    offsets = torch.arange(-radius, radius + 1, dtype=forward.dtype)
    kernel = torch.exp(-0.5 * (offsets / FACING_SIGMA) ** 2)
    kernel = kernel / kernel.sum()
    padded = torch.cat([forward[:1].expand(radius, 3), forward, forward[-1:].expand(radius, 3)])
    smoothed: Tensor = torch.nn.functional.conv1d(padded.t()[:, None], kernel[None, None])
    return smoothed.squeeze(1).t()


def _heading(forward: Float[Tensor, "*F 3"]) -> Float[Tensor, "*F 4"]:
    forward = (forward / forward.norm(dim=-1, keepdim=True)).float()
    turn = quat_between(forward, forward.new_tensor([0, 0, 1]))
    # Where the body faces exactly -Z the public scripts give NaN, but it can only turn about Y.
    is_backward = (forward[..., :1] == 0) & (forward[..., 2:] < 0)
    return torch.where(is_backward, turn.new_tensor([0, 0, 1, 0]), turn)


def _half_angle(turn: Float[Tensor, "T 4"], *, keep_wrap: bool) -> Float[Tensor, "T"]:
    if keep_wrap:
        return torch.asin(turn[:, 2])
    sign = torch.where(turn[:, 0] < 0, -1.0, 1.0)
    return torch.atan2(sign * turn[:, 2], sign * turn[:, 0])
