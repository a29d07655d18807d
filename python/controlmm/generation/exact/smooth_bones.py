"""Bones of the right length for a whole clip at once: frames help each other, feet that stand go on standing.

Minimises over all joints ``x`` of a clip, with ``d = x - start``,

    d^T R d + w |d_{t+1} - d_t|^2 + p |x_{t+1} - x_t|^2 (planted toes) + m (|bone| - length)^2

by Gauss-Newton's method; R = 10 L + 1 with the skeleton's Laplacian, as in ``projection``. Frames meet only
their neighbours, coordinate by coordinate, so that a step is one sweep through the clip and one back.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.generation.exact.projection import STIFFNESS, graph_laplacian
from controlmm.motion.skeleton import Skeleton

_STEPS = 4
_STEADY = 100.0  # w, of changes from frame to frame
_STANDS = 1e4  # p
_BONES = 1e5  # m
_HELD, _FOOT = 1e9, 1e3  # resistance of a coordinate; free ones have about 1


def smooth_bones(
    start: Float[Tensor, "T J 3"],
    lengths: Float[Tensor, "J"],
    held: Bool[Tensor, "T J 3"],
    planted: Bool[Tensor, "T J"],
    skeleton: Skeleton,
) -> Float[Tensor, "T J 3"]:
    """Joints near ``start`` whose bones have their lengths up to a fraction of a millimetre; float64.

    Args:
        start: Positions.
        lengths: Of the bone from every joint to its parent; that of the root is not used.
        held: Coordinates that stay.
        planted: Joints of the feet that stand from a frame to the next.
        skeleton: The hierarchy.
    """
    start = start.double()
    resistance = torch.kron(STIFFNESS * graph_laplacian(skeleton) + torch.eye(start.shape[1]), torch.eye(3))
    extra = _HELD * held.double()
    extra[:, list(skeleton.foot_joints)] += _FOOT
    resistance = resistance + torch.diag_embed(extra.flatten(1))
    stands = _STANDS * planted[:-1, :, None].expand(-1, -1, 3).double().flatten(1)  # (T-1, 3J)
    stands = stands.where(~(held[:-1] & held[1:]).flatten(1), 0.0)
    is_toe = torch.zeros(start.shape[1:], dtype=torch.bool)
    is_toe[[skeleton.left_foot[1], skeleton.right_foot[1]]] = True  # an ankle turns about it: its steps stay
    is_toe, moved = is_toe.flatten(), start
    for _ in range(_STEPS):
        slopes, short = bone_slopes(moved, lengths, skeleton)
        change = (moved - start).flatten(1)
        step = torch.where(is_toe, moved.flatten(1).diff(dim=0), change.diff(dim=0))
        pull = _STEADY * change.diff(dim=0) + stands * step
        force = -(resistance @ change[..., None])[..., 0] + _BONES * (slopes.mT @ short[..., None])[..., 0]
        force[:-1] += pull
        force[1:] -= pull
        blocks = resistance + _BONES * slopes.mT @ slopes
        moved = moved + solve_chain(blocks, _STEADY + stands, force).unflatten(1, start.shape[1:])
    return torch.where(held, start, moved)


def bone_slopes(
    joints: Float[Tensor, "T J 3"], lengths: Float[Tensor, "J"], skeleton: Skeleton
) -> tuple[Float[Tensor, "T J-1 3J"], Float[Tensor, "T J-1"]]:
    """How bone lengths answer to the joints, and what every bone lacks."""
    frames, count = joints.shape[:2]
    children, parents = torch.arange(1, count), torch.tensor(skeleton.parents[1:])
    bones = joints[:, children] - joints[:, parents]
    length = bones.norm(dim=-1)
    direction = bones / length.clamp(min=1e-9)[..., None]
    slopes = torch.zeros(frames, count - 1, count, 3, dtype=torch.float64)
    slopes[:, children - 1, children] = direction
    slopes[:, children - 1, parents] = -direction
    return slopes.flatten(2), lengths.double()[1:] - length


def solve_chain(
    blocks: Float[Tensor, "T N N"], ties: Float[Tensor, "T-1 N"], right: Float[Tensor, "T N"]
) -> Float[Tensor, "T N"]:
    """``x`` of ``blocks_t x_t + ties (x_t - its neighbours) = right_t``; ties go coordinate by coordinate."""
    blocks = blocks.clone()
    blocks[:-1].diagonal(dim1=1, dim2=2).add_(ties)
    blocks[1:].diagonal(dim1=1, dim2=2).add_(ties)
    inverses: list[Tensor] = []
    known = [right[0]]
    for frame, block in enumerate(blocks):
        if frame:
            tie = ties[frame - 1]
            block = block - tie[:, None] * inverses[-1] * tie
            known.append(right[frame] + tie * (inverses[-1] @ known[-1]))
        inverses.append(torch.cholesky_inverse(torch.linalg.cholesky(block)))
    found = [inverses[-1] @ known[-1]]
    for frame in range(len(ties) - 1, -1, -1):
        found.append(inverses[frame] @ (known[frame] + ties[frame] * found[-1]))
    return torch.stack(found[::-1])
