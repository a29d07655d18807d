"""Poses and steps held wherever the body stands: the relative loss of multi-track timelines."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.generation.clip_sums import clip_sums
from controlmm.motion.body_parts import body_parts
from controlmm.motion.skeleton import Skeleton


@dataclass(frozen=True, eq=False)
class RelativeTerm:
    """Mean squared error of poses and of the root's steps, both seen from the root as it faces, in m^2.

    Source: MaskControl's published code, where positions in the heading frame and the root's velocity are
    compared, since motions that were made apart have no common place.

    Attributes:
        poses: (B, T, J, 3) wanted joints seen from the root: x and z relative to it, y absolute.
        steps: (B, T, 2) wanted displacement of the root to the next frame, seen likewise; 0 in the last.
        turns: (B, T, 2) cosine and sine of the wanted turn to the next frame.
        known: (B, T, J) joints that count; the root's column says where its steps count.
        hips: Left and right hip.
        arm: A metre in the skeleton's unit: a turn counts as what it moves at that distance.
    """

    poses: Float[Tensor, "B T J 3"]
    steps: Float[Tensor, "B T 2"]
    turns: Float[Tensor, "B T 2"]
    known: Bool[Tensor, "B T J"]
    hips: tuple[int, int]
    arm: float

    @classmethod
    def towards(
        cls, joints: Float[Tensor, "B T J 3"], known: Bool[Tensor, "T J"], *, padded: int, skeleton: Skeleton
    ) -> RelativeTerm:
        """The term of the poses and steps of ``joints``, for clips padded to ``padded`` frames."""
        missing = padded - joints.shape[1]
        longer = torch.cat([joints, joints[:, -1:].expand(-1, missing, -1, -1)], dim=1)
        counted = torch.nn.functional.pad(known, (0, 0, 0, missing)).expand(len(joints), -1, -1)
        hips = {part.name: part.joints[0] for part in body_parts(skeleton)}
        sides = hips["left_leg"], hips["right_leg"]
        return cls(*_seen_from_root(longer, sides), counted, sides, 1 / skeleton.metres)

    def values(self, joints: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B"]:
        """See :class:`JointTerm`."""
        poses, steps, turns = _seen_from_root(joints, self.hips)
        off = (poses - self.poses).square().mean(-1)
        moves = self.known[:, :-1, 0] & self.known[:, 1:, 0]
        moved = (steps - self.steps).square().sum(-1) + (self.arm * (turns - self.turns)).square().sum(-1)
        return _mean(off, self.known) + _mean(moved[:, :-1], moves)

    def errors(self, joints: Float[Tensor, "B T J 3"]) -> Float[Tensor, "B"]:
        """Mean distance of the joints that count, seen from the root; ``joints`` may be fewer frames."""
        frames = joints.shape[1]
        poses, _, _ = _seen_from_root(joints, self.hips)
        return _mean((poses - self.poses[:, :frames]).norm(dim=-1), self.known[:, :frames])

    def select(self, clips: Int[Tensor, " N"]) -> RelativeTerm:
        """See :class:`JointTerm`."""
        wanted = {name: getattr(self, name)[clips] for name in ("poses", "steps", "turns", "known")}
        return replace(self, **wanted)


def _seen_from_root(
    joints: Float[Tensor, "B T J 3"], hips: tuple[int, int]
) -> tuple[Float[Tensor, "B T J 3"], Float[Tensor, "B T 2"], Float[Tensor, "B T 2"]]:
    """Poses, steps and turns; the root faces at right angles to the line between the hips."""
    across = joints[:, :, hips[0]] - joints[:, :, hips[1]]
    across = torch.nn.functional.normalize(across[..., [0, 2]], dim=-1)  # cos and -sin of the heading
    cos, sin = across[..., 0], -across[..., 1]
    relative = joints - joints[:, :, :1] * joints.new_tensor([1.0, 0.0, 1.0])
    poses = torch.stack(
        [
            relative[..., 0] * cos[..., None] - relative[..., 2] * sin[..., None],
            relative[..., 1],
            relative[..., 0] * sin[..., None] + relative[..., 2] * cos[..., None],
        ],
        dim=-1,
    )
    step = torch.nn.functional.pad(joints[:, 1:, 0] - joints[:, :-1, 0], (0, 0, 0, 1))
    steps = torch.stack(
        [step[..., 0] * cos - step[..., 2] * sin, step[..., 0] * sin + step[..., 2] * cos], -1
    )
    next_cos, next_sin = (torch.cat([x[:, 1:], x[:, -1:]], dim=1) for x in (cos, sin))
    turns = torch.stack([cos * next_cos + sin * next_sin, cos * next_sin - sin * next_cos], dim=-1)
    return poses, steps, turns


def _mean(values: Float[Tensor, "B *N"], counts: Bool[Tensor, "B *N"]) -> Float[Tensor, "B"]:
    """Mean over what counts; 0 where nothing does."""
    return clip_sums(values * counts) / counts.flatten(1).sum(1).clamp(min=1)
