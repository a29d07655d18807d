"""How the controlled coordinates of a clip answer to the decoder's channels: the kinematics' Jacobian."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.generation.coordinate_groups import Groups


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

    def dense(self) -> Float[Tensor, "N T D"]:
        """All rows in full."""
        count, frames = len(self.root), self.root.shape[2]
        return torch.cat([self.root, self.local.to_dense().view(count, -1, frames)], dim=1).mT

    def gram(self, products: Float[Tensor, "E S E S"], columns: Int[Tensor, "D"]) -> Float[Tensor, "N N"]:
        """``K G K^T``, for products ``G`` of the decoder's rows.

        Args:
            products: Of at least our frames and channels, of which the root's come first. They may take much
                memory: nothing of them is copied but what is the root's own.
            columns: Which channels of theirs ours are.
        """
        span, frames = products.shape[1], self.root.shape[2]
        root, local = self.root.flatten(1).to(products.dtype), self._local_among(products, columns)
        answers = torch.sparse.mm(local, products.view(-1, len(products) * span))
        of_root = answers.view(len(root), -1, span)[:, :3, :frames].flatten(1) @ root.T
        own = products[:3, :frames, :3, :frames].reshape(3 * frames, -1)
        gram: Tensor = root @ own @ root.T + of_root + of_root.T + torch.sparse.mm(local, answers.T)
        return gram

    def _local_among(self, products: Float[Tensor, "E S E S"], columns: Int[Tensor, "D"]) -> Tensor:
        """``local`` with columns for all of their channels and frames."""
        span, frames = products.shape[1], self.root.shape[2]
        row, place = self.local.indices()
        place = columns[3 + place // frames] * span + place % frames
        size = (len(self.root), len(products) * span)
        values = self.local.values().to(products.dtype)
        return torch.sparse_coo_tensor(torch.stack([row, place]), values, size, check_invariants=False)


def kinematic_rows(
    features: Float[Tensor, "T D"],
    joints: Float[Tensor, "T J 3"],
    mask: Bool[Tensor, "T J 3"],
    std: Float[Tensor, "D"],
    groups: Groups | None = None,
) -> KinematicRows:
    """Rows for the coordinates that ``mask`` marks, in the order of ``mask.nonzero()``; float64.

    Args:
        features: De-normalised root channels and positions of the joints (D = 4 + 3 (J - 1)).
        joints: What they decode to.
        mask: The controlled coordinates.
        std: Of the channels, which are normalised.
        groups: Sums of coordinates; then rows are theirs.
    """
    features, joints, std = features.double(), joints.double(), std.double()
    frame, joint, axis = mask.nonzero().T
    if groups is None:
        groups = Groups(torch.arange(len(frame)), torch.ones(len(frame), dtype=torch.float64))
    yaw = torch.cat([features.new_zeros(1), 2 * features[:-1, 0].cumsum(0)])
    cos, sin = yaw.cos(), yaw.sin()
    return KinematicRows(
        _root_rows(joints, frame, joint, axis, cos, sin, groups) * std[:3, None],
        _local_rows(frame, joint, axis, cos, sin, std, groups),
    )


def _root_rows(
    joints: Tensor,
    frame: Int[Tensor, "N"],
    joint: Tensor,
    axis: Tensor,
    cos: Tensor,
    sin: Tensor,
    groups: Groups,
) -> Float[Tensor, "N 3 T"]:
    """A turn of frame i swings all that comes later about the root of frame i; a step of it shifts it.

    So a row at frame i needs no more of a group than two sums over its frames behind i.
    """
    count, frames, root = len(groups), len(joints), joints[:, 0]
    lever = joints[frame, joint, torch.where(axis == 0, 2, 0)]
    here = torch.zeros(2, count, frames, dtype=joints.dtype)
    here[0, groups.index, frame] = groups.weight
    here[1, groups.index, frame] = groups.weight * lever
    after = torch.zeros_like(here)
    after[..., :-1] = here.flip(-1).cumsum(-1).flip(-1)[..., 1:]
    weights, levers = after
    own = torch.zeros(count, 1, dtype=axis.dtype)
    own[groups.index, 0] = axis
    next_cos, next_sin = cos.roll(-1), sin.roll(-1)  # a velocity is turned by the next frame's heading
    along_x = [-2 * (levers - weights * root[:, 2]), weights * next_cos, -weights * next_sin]
    along_z = [2 * (levers - weights * root[:, 0]), weights * next_sin, weights * next_cos]
    rows = [torch.where(own == 0, x, z) for x, z in zip(along_x, along_z, strict=True)]
    return torch.stack(rows, dim=1) * (own != 1)[:, None]


def _local_rows(
    frame: Tensor,
    joint: Tensor,
    axis: Tensor,
    cos: Tensor,
    sin: Tensor,
    std: Tensor,
    groups: Groups,
) -> Tensor:
    """Sparse: the height of the root is channel 3, coordinate a of joint j is channel 1 + 3 j + a."""
    frames, rows, weight = len(cos), groups.index, groups.weight
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
    values = [(value * weight)[used] * std[channel[used]] for used, channel, value in entries]
    size = (len(groups), (len(std) - 3) * frames)
    return torch.sparse_coo_tensor(
        torch.cat(index, 1), torch.cat(values), size, check_invariants=False
    ).coalesce()
