"""What a motion still misses of its targets, as the body that should make up for it sees it."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.motion.heading import heading, turned
from controlmm.motion.skeleton import skeleton_of_joints


def missing_in_heading(
    targets: Float[Tensor, "B T J 3"],
    mask: Bool[Tensor, "B T J 3"],
    current: Float[Tensor, "B T J 3"],
    *,
    metres: float,
    fps: float,
) -> tuple[Float[Tensor, "B T J 3"], Float[Tensor, "B T J 3"]]:
    """What is missing (metres) and the speed that would bring it (m/s), in the heading of ``current``.

    That is the frame in which the codes' root velocities are: a token that should walk faster to the left
    reads so, wherever the body faces in the world. Zero where nothing is asked for.

    Args:
        targets: Global positions to reach, in the skeleton's unit.
        mask: Which coordinates are controlled.
        current: Positions of the motion so far.
        metres: Length of the skeleton's unit.
        fps: Frames a second.
    """
    led = mask.transpose(2, 0).flatten(1).any(1).nonzero()[:, 0]  # most joints have no target in any clip
    own_mask, own_targets, own = (x.index_select(2, led) for x in (mask, targets, current))
    missing = torch.where(own_mask, own_targets - own, 0.0) * metres
    speed = slopes(missing, own_mask) * fps
    yaw = -heading(current, skeleton_of_joints(current.shape[2]))[:, :, None]
    nothing = torch.zeros_like(current)
    missing, speed = (nothing.index_copy(2, led, turned(way, yaw)) for way in (missing, speed))
    return missing, speed


def slopes(values: Float[Tensor, "B T J 3"], mask: Bool[Tensor, "B T J 3"]) -> Float[Tensor, "B T J 3"]:
    """Slope per frame of the polyline through the values that ``mask`` marks, in the piece after each frame.

    The line starts from 0 at frame 0, where every motion stands at the origin; it is flat after the last
    marked frame.
    """
    frames = values.shape[1]
    time = torch.arange(frames, device=values.device)[None, :, None, None].expand(mask.shape)
    before = torch.where(mask, time, 0).cummax(dim=1).values
    marked_from = torch.where(mask, time, frames).flip(1).cummin(dim=1).values.flip(1)
    after = torch.cat([marked_from[:, 1:], torch.full_like(marked_from[:, :1], frames)], dim=1)
    rise = values.gather(1, after.clamp(max=frames - 1)) - values.gather(1, before)
    return torch.where(after < frames, rise / (after - before).clamp(min=1), 0.0)
