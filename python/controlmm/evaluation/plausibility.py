"""How physical a motion is: depth below the floor, jerk, bone lengths, foot contacts."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from controlmm.models.rvq_vae import frame_mask
from controlmm.motion.features import bone_lengths
from controlmm.motion.layout import feature_layout
from controlmm.motion.skeleton import HUMANML3D, Skeleton, skeleton_of_width

_CONTACT = 0.5  # a contact channel above it says that the joint rests


def floor_penetration(
    joints: Float[Tensor, "B T J 3"], *, lengths: Int[Tensor, "B"] | None = None
) -> Float[Tensor, "B"]:
    """Mean over frames of how far the lowest joint is below y = 0, in the unit of ``joints``; 0 if never.

    Args:
        joints: Global positions, Y up, ground at y = 0.
        lengths: Frames of each clip; ``None`` counts all ``T``.
    """
    depth = (-joints[..., 1]).amax(-1).clamp(min=0)
    return _clip_mean(depth, _lengths(joints, lengths))


def mean_jerk(
    joints: Float[Tensor, "B T J 3"], *, lengths: Int[Tensor, "B"] | None = None, fps: float = 20.0
) -> Float[Tensor, "B"]:
    """Mean length of the third time derivative of the joints (m/s^3), by third differences.

    Smooth motion of people has some; values far above those of recorded motion mean jitter, far below them
    mean that the motion was smoothed away. Differences that reach beyond a clip's end are not counted.
    0 for clips of fewer than four frames.
    """
    lengths = _lengths(joints, lengths)
    if joints.shape[1] < 4:
        return joints.new_zeros(len(joints))
    jerk = torch.diff(joints, n=3, dim=1).norm(dim=-1).mean(-1) * fps**3  # (B, T-3)
    return _clip_mean(jerk, lengths - 3)


def bone_length_deviation(
    joints: Float[Tensor, "B T J 3"],
    *,
    lengths: Int[Tensor, "B"] | None = None,
    skeleton: Skeleton = HUMANML3D,
) -> Float[Tensor, "B"]:
    """Mean over bones of the standard deviation of their length over time, in the unit of ``joints``.

    Positions are decoded joint by joint, so nothing but training keeps bones rigid; 0 for a rigid body.
    """
    bones = bone_lengths(joints.flatten(0, 1), skeleton).unflatten(0, joints.shape[:2])[..., 1:]
    lengths = _lengths(joints, lengths)
    inside = frame_mask(lengths, joints.shape[1])[..., None]
    mean = (bones * inside).sum(1, keepdim=True) / lengths.clamp(min=1)[:, None, None]
    variance = ((bones - mean) * inside).square().sum(1) / lengths.clamp(min=1)[:, None]
    deviation: Tensor = variance.sqrt().mean(-1)
    return deviation


def contact_consistency(
    features: Float[Tensor, "B T D"],
    joints: Float[Tensor, "B T J 3"],
    *,
    lengths: Int[Tensor, "B"] | None = None,
) -> Float[Tensor, "B"]:
    """Share of foot and frame in which the contact channel says what the foot does.

    A foot rests when it moves by less than the threshold that the channels were made with (squared
    displacement to the next frame, 0.002 m^2 for HumanML3D). The last frame has no next one and is left out.

    Args:
        features: De-normalised features.
        joints: Global positions of the same motion, in the skeleton's unit.
        lengths: Frames of each clip; ``None`` counts all ``T``.
    """
    skeleton = skeleton_of_width(features.shape[-1])
    feet = joints[:, :, list(skeleton.foot_joints)]
    rests = torch.diff(feet, dim=1).square().sum(-1) < skeleton.contact_threshold  # (B, T-1, 4)
    says = features[:, :-1, feature_layout(skeleton).foot_contacts] > _CONTACT
    return _clip_mean((rests == says).float().mean(-1), _lengths(joints, lengths) - 1)


def _clip_mean(values: Float[Tensor, "B N"], counts: Int[Tensor, "B"]) -> Float[Tensor, "B"]:
    """Mean of the first ``counts[b]`` values of each clip; 0 where there are none."""
    inside = frame_mask(counts, values.shape[1])
    return (values * inside).sum(1) / counts.clamp(min=1)


def _lengths(joints: Tensor, lengths: Tensor | None) -> Tensor:
    if joints.ndim != 4 or joints.shape[-1] != 3:
        raise ValueError(f"`joints` must be (B, T, J, 3), got {tuple(joints.shape)}.")
    frames = joints.shape[1]
    if lengths is None:
        return torch.full((len(joints),), frames)
    if tuple(lengths.shape) != (len(joints),) or bool(((lengths < 1) | (lengths > frames)).any()):
        raise ValueError(
            f"`lengths` must hold one number from 1 to {frames} for each of the {len(joints)} clips, "
            f"got {lengths.tolist()}."
        )
    return lengths
