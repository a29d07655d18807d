"""Plain-torch twins of the kernels that put joints on targets and give bones their lengths."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.ops.pose_weights import (
    BONES,
    DAMPING,
    FOOT_RESISTANCE,
    LATER_DAMPING,
    LONGEST,
    SLACK,
    SMOOTHNESS,
    STANDING,
    STEADINESS,
    STIFFNESS,
)

_EXACT = 1e-12  # compliance of what is held, as a share of the diagonal


def project_change_reference(
    change: Float[Tensor, "T J 3"],
    held: Bool[Tensor, "T J 3"],
    planted: Bool[Tensor, "T J"],
    parents: Sequence[int],
) -> Float[Tensor, "T J 3"]:
    """See :func:`controlmm.ops.project_change`. By constraints: where ``A x = r`` must hold of a change whose
    size is ``x^T R x``, it is ``R^-1 A^T (A R^-1 A^T)^-1 r``; here in the eigenvectors of skeleton and time.
    """
    frames, result = len(change), torch.zeros_like(change)
    stiffness, modes = torch.linalg.eigh(graph_laplacian(parents))
    second = torch.eye(frames, dtype=torch.float64).diff(n=2, dim=0)
    bending, waves = torch.linalg.eigh(second.T @ second)
    size = STIFFNESS * stiffness.clamp(min=0) + 1
    inverse = 1 / (size[None, :] + SMOOTHNESS * bending.clamp(min=0)[:, None])  # (T, J)
    for axis in range(3):
        here = held[..., axis]
        if not here.any():
            continue
        steps = planted[:-1] & ~(here[:-1] & here[1:])
        (frame, joint), (start, foot) = here.nonzero().T, steps.nonzero().T
        rows = torch.cat(
            [
                waves[frame][:, :, None] * modes[joint][:, None, :],
                (waves[start + 1] - waves[start])[:, :, None] * modes[foot][:, None, :],
            ]
        ).flatten(1)
        matrix = (rows * inverse.flatten()) @ rows.T
        compliance = _EXACT * matrix.diagonal()
        compliance[len(frame) :] = 1 / STANDING
        wanted = torch.cat([change[..., axis][here], change.new_zeros(len(start))])
        forces = torch.linalg.solve(matrix + compliance.diag(), wanted)
        answer = (rows.T @ forces).unflatten(0, inverse.shape) * inverse
        result[..., axis] = torch.where(here, change[..., axis], waves @ answer @ modes.T)
    return result


def graph_laplacian(parents: Sequence[int]) -> Float[Tensor, "J J"]:
    """Of the tree of bones."""
    count = len(parents)
    laplacian = torch.zeros(count, count, dtype=torch.float64)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            laplacian[[joint, parent], [joint, parent]] += 1
            laplacian[joint, parent] -= 1
            laplacian[parent, joint] -= 1
    return laplacian


def smooth_bones_reference(
    joints: Float[Tensor, "T J 3"],
    lengths: Float[Tensor, "J"],
    held: Bool[Tensor, "T J 3"],
    planted: Bool[Tensor, "T J"],
    parents: Sequence[int],
    is_foot: Bool[Tensor, "J"],
    is_toe: Bool[Tensor, "J"],
    *,
    enough: float,
    steps: int,
) -> Float[Tensor, "T J 3"]:
    """See :func:`controlmm.ops.smooth_bones`."""
    start, count = joints, joints.shape[1]
    resistance = torch.kron(STIFFNESS * graph_laplacian(parents) + torch.eye(count), torch.eye(3))
    extra = torch.zeros(count, 3, dtype=torch.float64)
    extra[is_foot] = FOOT_RESISTANCE
    resistance = resistance + extra.flatten().diag()
    free, turns = ~held.flatten(1), is_toe.repeat_interleave(3)
    stands = STANDING * planted[:-1, :, None].expand(-1, -1, 3).double().flatten(1)  # (T-1, 3J)
    stands = stands * (free[:-1] | free[1:])
    ties, moved = STEADINESS + stands, start
    for number in range(steps):
        slopes, short = bone_slopes(moved, lengths, parents)
        if not short.abs().max() > enough:
            break
        change = (moved - start).flatten(1)
        step = torch.where(turns, moved.flatten(1).diff(dim=0), change.diff(dim=0))
        pull = STEADINESS * change.diff(dim=0) + stands * step
        force = -(resistance @ change[..., None])[..., 0] + BONES * (slopes.mT @ short[..., None])[..., 0]
        force[:-1] += pull
        force[1:] -= pull
        blocks = resistance + BONES * slopes.mT @ slopes
        blocks = blocks + (LATER_DAMPING if number else DAMPING) * torch.eye(3 * count)
        blocks[:-1].diagonal(dim1=1, dim2=2).add_(ties)
        blocks[1:].diagonal(dim1=1, dim2=2).add_(ties)
        both = free[:, :, None] & free[:, None, :]
        blocks = torch.where(both, blocks, torch.diag_embed((~free).double()))
        move = solve_chain(blocks, ties * (free[:-1] & free[1:]), force * free)
        moved = moved + move.unflatten(1, start.shape[1:])
    return moved


def frame_bones_reference(
    joints: Float[Tensor, "T J 3"],
    lengths: Float[Tensor, "J"],
    held: Bool[Tensor, "T J 3"],
    planted: Bool[Tensor, "T J"],
    parents: Sequence[int],
    is_foot: Bool[Tensor, "J"],
    *,
    enough: float,
    steps: int,
    metre: float,
) -> Float[Tensor, "T J 3"]:
    """See :func:`controlmm.ops.frame_bones`."""
    count, free, moved = joints.shape[1], ~held.flatten(1), joints
    resistance = torch.kron(STIFFNESS * graph_laplacian(parents) + torch.eye(count), torch.eye(3))
    stays = STANDING * planted.double()
    stays[:, is_foot] += FOOT_RESISTANCE
    matrix = resistance + torch.diag_embed(stays[..., None].expand(-1, -1, 3).flatten(1))
    both = free[:, :, None] & free[:, None, :]
    matrix = torch.where(both, matrix, torch.diag_embed((~free).double()))
    yielding = torch.linalg.inv(matrix) * both  # (T, 3J, 3J)
    for step in range(steps):
        if 2 * step == steps:  # a leg nearly straight swings about while its foot is heavier than its knee
            yielding = torch.linalg.inv(matrix + STANDING * torch.diag_embed(free.double())) * both
        slopes, short = bone_slopes(moved, lengths, parents)
        is_done = short.abs().amax(1) < enough
        if is_done.all():
            break
        answers = yielding @ slopes.mT  # (T, 3J, J - 1)
        forces = torch.linalg.solve(slopes @ answers + SLACK * torch.eye(count - 1), short[..., None])
        move = (answers @ forces)[..., 0]
        share = (LONGEST * metre / move.abs().amax(1)).clamp(max=1) * ~is_done
        moved = moved + (share[:, None] * move).unflatten(1, (count, 3))
    return moved


def bone_slopes(
    joints: Float[Tensor, "T J 3"], lengths: Float[Tensor, "J"], parents: Sequence[int]
) -> tuple[Float[Tensor, "T J-1 3J"], Float[Tensor, "T J-1"]]:
    """How bone lengths answer to the joints, and what every bone lacks."""
    frames, count = joints.shape[:2]
    children, up = torch.arange(1, count), torch.tensor(parents[1:])
    bones = joints[:, children] - joints[:, up]
    length = bones.norm(dim=-1)
    direction = bones / length.clamp(min=1e-9)[..., None]
    slopes = torch.zeros(frames, count - 1, count, 3, dtype=torch.float64)
    slopes[:, children - 1, children] = direction
    slopes[:, children - 1, up] = -direction
    return slopes.flatten(2), lengths[1:] - length


def solve_chain(
    blocks: Float[Tensor, "T N N"], ties: Float[Tensor, "T-1 N"], right: Float[Tensor, "T N"]
) -> Float[Tensor, "T N"]:
    """``x`` of ``blocks_t x_t - ties_{t-1} x_{t-1} - ties_t x_{t+1} = right_t``: a sweep there and one back.

    The ties are already on the diagonals of the blocks.
    """
    inverses = [torch.linalg.inv(blocks[0])]
    known = [right[0]]
    for frame in range(1, len(blocks)):
        tie = ties[frame - 1]
        known.append(right[frame] + tie * (inverses[-1] @ known[-1]))
        inverses.append(torch.linalg.inv(blocks[frame] - tie[:, None] * inverses[-1] * tie))
    found = [inverses[-1] @ known[-1]]
    for frame in range(len(ties) - 1, -1, -1):
        found.append(inverses[frame] @ (known[frame] + ties[frame] * found[-1]))
    return torch.stack(found[::-1])
