"""How the controlled coordinates of a clip answer to the decoder's channels: the kinematics' Jacobian."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class KinematicRows:
    """Rows of the Jacobian for ``N`` controlled coordinates, in metres per unit of a channel.

    The path of the root sums the three root velocities of all earlier frames: those columns are dense. Every
    other channel moves one coordinate or turns into two, in its own frame.

    Attributes:
        root: (N, 3, T), for half yaw velocity, x and z velocity.
        local: (N, (D - 3) T) sparse, for root height and the joints' positions, channel-major.
    """

    root: Float[Tensor, "N 3 T"]
    local: Tensor

    def summed(self, group: Int[Tensor, "N"], weight: Float[Tensor, "N"]) -> KinematicRows:
        """Rows of weighted sums, of which every coordinate enters one: number ``group``."""
        count = int(group.max()) + 1
        root = torch.zeros(count, *self.root.shape[1:], dtype=self.root.dtype)
        root.index_add_(0, group, self.root * weight[:, None, None])
        (row, column), value = self.local.indices(), self.local.values()
        local = torch.sparse_coo_tensor(
            torch.stack([group[row], column]),
            value * weight[row],
            (count, self.local.shape[1]),
            check_invariants=False,
        )
        return KinematicRows(root, local.coalesce())

    def gram(self, channels: Float[Tensor, "D T D T"]) -> Float[Tensor, "N N"]:
        """``K G K^T`` for the channels' own ``G``."""
        frames = channels.shape[1]
        whole = channels.reshape(channels.shape[0] * frames, -1)
        split = 3 * frames
        root, local = self.root.flatten(1), self.local
        cross = torch.sparse.mm(local, (root @ whole[:split, split:]).T)  # (N, N): local x root
        own = torch.sparse.mm(local, torch.sparse.mm(local, whole[split:, split:]).T)
        gram: Tensor = root @ whole[:split, :split] @ root.T + cross + cross.T + own
        return gram


def kinematic_rows(
    features: Float[Tensor, "T D"],
    joints: Float[Tensor, "T J 3"],
    mask: Bool[Tensor, "T J 3"],
    std: Float[Tensor, "D"],
) -> KinematicRows:
    """Rows for the coordinates that ``mask`` marks, in the order of ``mask.nonzero()``; float64.

    Args:
        features: De-normalised root channels and positions of the joints (D = 4 + 3 (J - 1)).
        joints: What they decode to.
        mask: The controlled coordinates.
        std: Of the channels, which are normalised.
    """
    features, joints, std = features.double(), joints.double(), std.double()
    frames = len(features)
    frame, joint, axis = mask.nonzero().T
    yaw = torch.cat([features.new_zeros(1), 2 * features[:-1, 0].cumsum(0)])
    cos, sin = yaw.cos(), yaw.sin()
    return KinematicRows(
        _root_rows(joints, frame, joint, axis, cos, sin) * std[:3, None],
        _local_rows(frame, joint, axis, cos, sin, std, frames),
    )


def _root_rows(
    joints: Tensor, frame: Int[Tensor, "N"], joint: Tensor, axis: Tensor, cos: Tensor, sin: Tensor
) -> Float[Tensor, "N 3 T"]:
    """A turn of frame i swings all that comes later about the root of frame i; a step of it shifts it."""
    frames = len(joints)
    point, root = joints[frame, joint], joints[:, 0]
    is_earlier = torch.arange(frames) < frame[:, None]  # (N, T)
    swing_x = -2 * (point[:, 2, None] - root[:, 2])
    swing_z = 2 * (point[:, 0, None] - root[:, 0])
    next_cos, next_sin = cos.roll(-1), sin.roll(-1)  # a velocity is turned by the next frame's heading
    along_x = torch.stack([swing_x, next_cos.expand_as(swing_x), -next_sin.expand_as(swing_x)], dim=1)
    along_z = torch.stack([swing_z, next_sin.expand_as(swing_z), next_cos.expand_as(swing_z)], dim=1)
    along = torch.where((axis == 0)[:, None, None], along_x, along_z)
    rows: Tensor = along * (is_earlier & (axis != 1)[:, None])[:, None]
    return rows


def _local_rows(
    frame: Tensor, joint: Tensor, axis: Tensor, cos: Tensor, sin: Tensor, std: Tensor, frames: int
) -> Tensor:
    """Sparse: the height of the root is channel 3, coordinate a of joint j is channel 1 + 3 j + a."""
    rows = torch.arange(len(frame))
    is_root, is_height = joint == 0, axis == 1
    height = torch.where(is_root, 3, 2 + 3 * joint)
    turns = ~is_height & ~is_root
    sideways = turns & (axis == 2)
    entries = [
        (is_height, height, torch.ones_like(cos[frame])),
        (turns, 1 + 3 * joint, torch.where(sideways, sin[frame], cos[frame])),
        (turns, 3 + 3 * joint, torch.where(sideways, cos[frame], -sin[frame])),
    ]
    index = [
        torch.stack([rows[used], (channel[used] - 3) * frames + frame[used]]) for used, channel, _ in entries
    ]
    values = [value[used] * std[channel[used]] for used, channel, value in entries]
    size = (len(frame), (len(std) - 3) * frames)
    return torch.sparse_coo_tensor(
        torch.cat(index, 1), torch.cat(values), size, check_invariants=False
    ).coalesce()
