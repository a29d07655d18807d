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
        places: (3, E) row, channel and frame of what the others are not zero at, in this order.
        values: (E,) what is there.
    """

    root: Float[Tensor, "N 3 T"]
    places: Int[Tensor, "3 E"]
    values: Float[Tensor, "E"]

    def dense(self, channels: int) -> Float[Tensor, "N T D"]:
        """All rows in full, for so many channels."""
        count, _, frames = self.root.shape
        rows = torch.zeros(count, frames, channels, dtype=self.root.dtype)
        rows[..., :3] = self.root.mT
        row, channel, frame = self.places
        rows[row, frame, channel] = self.values
        return rows

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
        """All but the root's part, sparse, with columns for all of their channels and frames."""
        row, channel, frame = self.places
        place = torch.stack([row, columns[channel] * products.shape[1] + frame])
        size = (len(self.root), len(products) * products.shape[1])
        return torch.sparse_coo_tensor(place, self.values.to(products.dtype), size, check_invariants=False)


class KinematicPattern:
    """Which channels the controlled coordinates of a clip answer to, and what of it no motion changes.

    Args:
        mask: (T, J, 3) the controlled coordinates; rows are in the order of ``mask.nonzero()``.
        std: (D,) of the root's channels and the joints' positions (D = 4 + 3 (J - 1)), which are normalised.
        groups: Sums of coordinates; then rows are theirs.
    """

    def __init__(
        self, mask: Bool[Tensor, "T J 3"], std: Float[Tensor, "D"], groups: Groups | None = None
    ) -> None:
        self._std, frames = std.double(), len(mask)
        self._frame, self._joint, axis = mask.nonzero().T
        if groups is None:
            count = len(self._frame)
            groups = Groups(torch.arange(count), torch.ones(count, dtype=torch.float64))
        self._groups, self._lever_axis = groups, torch.where(axis == 0, 2, 0)
        self._weights = self._behind(torch.ones(len(self._frame), dtype=torch.float64), frames)
        self._axis = torch.zeros(len(groups), dtype=torch.int64)
        self._axis[groups.index] = axis
        self._places, self._sources, self._scales = self._local_places(axis)

    def rows(self, features: Float[Tensor, "T D"], joints: Float[Tensor, "T J 3"]) -> KinematicRows:
        """Their rows where the motion is; float64.

        Args:
            features: De-normalised channels.
            joints: What they decode to.
        """
        features, joints = features.double(), joints.double()
        yaw = torch.cat([features.new_zeros(1), 2 * features[:-1, 0].cumsum(0)])
        cos, sin = yaw.cos(), yaw.sin()
        turns = torch.stack([torch.ones_like(cos), cos, sin, -sin]).flatten()
        values = (turns[self._sources] * self._scales[0]) * self._scales[1]
        return KinematicRows(self._root_rows(joints, cos, sin), self._places, values)

    def _root_rows(
        self, joints: Float[Tensor, "T J 3"], cos: Float[Tensor, "T"], sin: Float[Tensor, "T"]
    ) -> Float[Tensor, "N 3 T"]:
        """A turn of frame i swings all that comes later about the root of frame i; a step of it shifts it.

        So a row at frame i needs no more of a group than two sums over its frames behind i.
        """
        root, nothing = joints[:, 0], torch.zeros_like(cos)
        levers = self._behind(joints[self._frame, self._joint, self._lever_axis], len(joints))
        next_cos, next_sin = cos.roll(-1), sin.roll(-1)  # a velocity is turned by the next frame's heading
        # By the axis of a coordinate; a height answers to none of these channels.
        pivot = torch.stack([root[:, 2], nothing, root[:, 0]])[self._axis]
        by_x = torch.stack([next_cos, nothing, next_sin])[self._axis]
        by_z = torch.stack([-next_sin, nothing, next_cos])[self._axis]
        side = levers.new_tensor([-2, 0, 2])[self._axis, None]
        rows = [side * (levers - self._weights * pivot), self._weights * by_x, self._weights * by_z]
        return torch.stack(rows, dim=1) * self._std[:3, None]

    def _behind(self, values: Float[Tensor, "N"], frames: int) -> Float[Tensor, "M T"]:
        """Of every group the weighted sum of what it has in later frames."""
        groups = self._groups
        here = torch.zeros(len(groups), frames, dtype=torch.float64)
        here[groups.index, self._frame] = groups.weight * values
        behind = torch.zeros_like(here)
        behind[:, :-1] = here.flip(1).cumsum(1).flip(1)[:, 1:]
        return behind

    def _local_places(
        self, axis: Int[Tensor, "N"]
    ) -> tuple[Int[Tensor, "3 E"], Int[Tensor, "E"], Float[Tensor, "2 E"]]:
        """Where all but the root's channels count, which turn they take there, and two factors of it.

        The height of the root is channel 3, coordinate a of joint j is channel 1 + 3 j + a.
        """
        frame, joint, groups = self._frame, self._joint, self._groups
        is_root, is_height = joint == 0, axis == 1
        turns, is_z = ~is_height & ~is_root, axis == 2
        one, cos, sin, minus_sin = range(4)
        entries = [
            (is_height, torch.where(is_root, 3, 2 + 3 * joint), torch.full_like(axis, one)),
            (turns, 1 + 3 * joint, torch.where(is_z, sin, cos)),
            (turns, 3 + 3 * joint, torch.where(is_z, cos, minus_sin)),
        ]
        used, channel, turn = (torch.cat(part) for part in zip(*entries, strict=True))
        row, frame, weight = (x.repeat(3)[used] for x in (groups.index, frame, groups.weight))
        channel, frames = channel[used], self._weights.shape[1]
        order = ((row * len(self._std) + channel) * frames + frame).argsort()
        places = torch.stack([row, channel, frame])[:, order]
        sources = (turn[used] * frames + frame)[order]
        return places, sources, torch.stack([weight, self._std[channel]])[:, order]
