"""Smallest smooth change of a motion that puts coordinates on their targets.

"Small" is measured along the skeleton and in time: a change of one joint asks its neighbours and the frames
around to come along. Per axis, with the skeleton's graph Laplacian ``L`` and second differences in time
``D``, the size of a change ``x`` (T, J) is ``x^T (10 L + 1) x + w |D x|^2``; with constraints ``A x = r`` it
is smallest at ``x = R^-1 A^T (A R^-1 A^T)^-1 r``. Source: the projection step of ProjFlow (CVPR 2026), which
has R = 10 L + 1 in every frame alone; the term in time is ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.motion.skeleton import Skeleton

STIFFNESS = 10.0  # of bones against change
SMOOTHNESS = 100.0  # of changes in time: a change of one frame spreads over about ten to each side
_EXACT, _SOFT = 1e-12, 1e-3  # compliance, as a share of the diagonal


@dataclass(frozen=True, eq=False)
class Constraints:
    """What a change of one axis must be.

    Attributes:
        frames: (N,) and ``joints`` (N,): where.
        values: (N, M) what the change must be there, for M axes that have the same constraints.
        steps: (S, 2) frame and joint whose change should go on unchanged into the next frame: planted feet.
            They give way to ``values``.
    """

    frames: Int[Tensor, "N"]
    joints: Int[Tensor, "N"]
    values: Float[Tensor, "N M"]
    steps: Int[Tensor, "S 2"]


class SmoothMetric:
    """The size of changes of clips of ``T`` frames, in the eigenvectors of skeleton and time."""

    def __init__(self, skeleton: Skeleton, frames: int) -> None:
        stiffness, self._modes = torch.linalg.eigh(graph_laplacian(skeleton))
        second = torch.eye(frames, dtype=torch.float64).diff(n=2, dim=0)
        bending, self._waves = torch.linalg.eigh(second.T @ second)
        size = STIFFNESS * stiffness.clamp(min=0) + 1
        self._inverse = 1 / (size[None, :] + SMOOTHNESS * bending.clamp(min=0)[:, None])  # (T, J)

    def project(self, constraints: Constraints) -> Float[Tensor, "T J M"]:
        """The smallest change that meets the constraints."""
        frames, joints = constraints.frames, constraints.joints
        rows = self._waves[frames][:, :, None] * self._modes[joints][:, None, :]  # (N, T, J)
        start, joint = constraints.steps.T
        along = self._waves[start + 1] - self._waves[start]
        rows = torch.cat([rows, along[:, :, None] * self._modes[joint][:, None, :]]).flatten(1)
        wanted = torch.cat(
            [constraints.values, constraints.values.new_zeros(len(start), constraints.values.shape[1])]
        )
        matrix = (rows * self._inverse.flatten()) @ rows.T
        compliance = torch.full((len(rows),), _EXACT, dtype=torch.float64)
        compliance[len(frames) :] = _SOFT
        diagonal = matrix.diagonal()
        diagonal += compliance * diagonal
        forces = torch.cholesky_solve(wanted, torch.linalg.cholesky(matrix))
        change = (rows.T @ forces).unflatten(0, self._inverse.shape) * self._inverse[..., None]
        result: Tensor = torch.einsum("tw,wjm,kj->tkm", self._waves, change, self._modes)
        return result


def graph_laplacian(skeleton: Skeleton) -> Float[Tensor, "J J"]:
    """Of the tree of bones."""
    count = skeleton.num_joints
    laplacian = torch.zeros(count, count, dtype=torch.float64)
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            laplacian[[joint, parent], [joint, parent]] += 1
            laplacian[joint, parent] -= 1
            laplacian[parent, joint] -= 1
    return laplacian


def project_on_targets(
    joints: Float[Tensor, "T J 3"],
    targets: Float[Tensor, "T J 3"],
    mask: Bool[Tensor, "T J 3"],
    planted: Bool[Tensor, "T J"],
    skeleton: Skeleton,
) -> Float[Tensor, "T J 3"]:
    """The joints with the masked coordinates on their targets, all else moved least; float64.

    Args:
        joints: Positions.
        targets: Wanted positions, in the same frame.
        mask: The controlled coordinates.
        planted: Joints that stand in this frame and the next; what moves them should move them alike.
        skeleton: Whose bones tie joints together.
    """
    metric, moved = SmoothMetric(skeleton, len(joints)), joints.double().clone()
    wanted = targets.double() - moved
    for axes in _axes_alike(mask):
        controlled = mask[..., axes[0]]
        frames, bones = controlled.nonzero().T
        steps = planted.clone()
        steps[-1] = False
        steps[:-1] &= ~(controlled[:-1] & controlled[1:])
        values = wanted[controlled][:, axes]
        moved[..., axes] += metric.project(Constraints(frames, bones, values, steps.nonzero()))
        moved[..., axes] = torch.where(controlled[..., None], targets.double()[..., axes], moved[..., axes])
    return moved


def _axes_alike(mask: Bool[Tensor, "T J 3"]) -> list[list[int]]:
    """The axes that have constraints, those with equal ones together: they share a factorisation."""
    groups: list[list[int]] = []
    for axis in range(3):
        if not mask[..., axis].any():
            continue
        alike = [group for group in groups if torch.equal(mask[..., group[0]], mask[..., axis])]
        if alike:
            alike[0].append(axis)
        else:
            groups.append([axis])
    return groups
