"""Foot skating ratio: how often a foot slides while it stands.

Source: Karunratanakul et al., "Guided Motion Diffusion", ICCV 2023; used by OmniControl and ControlMM.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool1d

from controlmm.motion.skeleton import HUMANML3D, Skeleton

MAX_HEIGHT = 0.05  # metres; lower in both frames of a pair means that the foot stands
MIN_SPEED = 0.5  # metres a second along the ground
_PUBLISHED_FPS = 20.0
WINDOW = 5  # frames over which the speed is averaged, so that a single jump of the decoder does not count


def foot_skating_ratio(
    joints: Float[Tensor, "B T J 3"],
    *,
    lengths: Int[Tensor, "B"] | None = None,
    skeleton: Skeleton = HUMANML3D,
) -> Float[Tensor, "B"]:
    """Share of the frame pairs in which a foot slides; recorded motion has 0.05 to 0.075, not 0.

    A foot slides when the ball of it is lower than 5 cm in both frames of a pair, and its horizontal speed
    and the 5-frame average of that speed (zeros beyond both ends) are above 0.5 m/s. The published scripts
    divide by the 195 pairs of the padded clip; here padding counts neither above nor below the line.

    Args:
        joints: Global positions in the skeleton's unit, Y up, ground at y = 0, at the skeleton's frame rate.
        lengths: Frames of each clip; ``None`` counts all ``T``.
        skeleton: Which joints are the feet.

    Returns:
        One ratio from 0 to 1 for each clip; 0 for a clip of one frame.

    Raises:
        ValueError: If the shape is not that of the skeleton, or a length is not from 1 to ``T``.
    """
    lengths = _checked_lengths(joints, lengths, skeleton)
    pair_counts = lengths - 1
    is_pair = torch.arange(joints.shape[1] - 1, device=joints.device) < pair_counts[:, None]  # (B, T-1)
    slides = _slides(_feet_in_metres(joints, skeleton), is_pair, fps=skeleton.fps)
    ratio: Tensor = slides.any(-1).sum(1) / pair_counts.clamp(min=1)
    return ratio


def published_skating_ratio(
    joints: Float[Tensor, "B T J 3"], *, skeleton: Skeleton = HUMANML3D
) -> Float[Tensor, "B"]:
    """The ratio as the published scripts compute it, for comparison with their tables.

    All ``T`` frames count, whatever the clip's length: give whole tensors padded to 196 frames, then 195 is
    the divisor also of short clips. The frame rate is taken for 20, also of KIT-ML's 12.5 fps.

    Raises:
        ValueError: If the shape is not that of the skeleton.
    """
    lengths = _checked_lengths(joints, None, skeleton)
    pairs = joints.shape[1] - 1
    everywhere = torch.ones(len(joints), pairs, dtype=torch.bool)
    ratio: Tensor = _slides(_feet_in_metres(joints, skeleton), everywhere, fps=_PUBLISHED_FPS).any(-1).sum(1)
    return ratio / (lengths - 1).clamp(min=1)


def _feet_in_metres(joints: Tensor, skeleton: Skeleton) -> Float[Tensor, "B T 2 3"]:
    feet = joints[:, :, [skeleton.left_foot[1], skeleton.right_foot[1]]]
    return feet * (0.001 if skeleton.unit == "mm" else 1.0)


def _slides(
    feet: Float[Tensor, "B T 2 3"], is_pair: Bool[Tensor, "B T-1"], *, fps: float
) -> Bool[Tensor, "B T-1 2"]:
    if feet.shape[1] < 2:
        return torch.zeros(len(feet), 0, 2, dtype=torch.bool)
    ground = feet[..., [0, 2]]
    speed = (ground[:, 1:] - ground[:, :-1]).norm(dim=-1) * fps * is_pair[..., None]  # (B, T-1, 2)
    average = avg_pool1d(speed.mT, WINDOW, stride=1, padding=WINDOW // 2).mT
    is_low = feet[..., 1] < MAX_HEIGHT
    slides: Tensor = is_low[:, 1:] & is_low[:, :-1] & (speed > MIN_SPEED) & (average > MIN_SPEED)
    return slides


def _checked_lengths(joints: Tensor, lengths: Tensor | None, skeleton: Skeleton) -> Tensor:
    if joints.ndim != 4 or tuple(joints.shape[2:]) != (skeleton.num_joints, 3) or not joints.shape[1]:
        raise ValueError(
            f"`joints` must have shape (B, T, {skeleton.num_joints}, 3) with T >= 1 for the {skeleton.name} "
            f"skeleton, got {tuple(joints.shape)}."
        )
    frames = joints.shape[1]
    if lengths is None:
        return torch.full((len(joints),), frames, device=joints.device)
    if tuple(lengths.shape) != (len(joints),) or bool(((lengths < 1) | (lengths > frames)).any()):
        raise ValueError(
            f"`lengths` must hold one number from 1 to {frames} for each of the {len(joints)} clips, "
            f"got {lengths.tolist()}."
        )
    return lengths
