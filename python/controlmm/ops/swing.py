"""Local rotations that follow bones, for one clip in double precision, without gradients."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.ops.backend import Backend, core, runs_native
from controlmm.ops.exact_checks import chain_bones, check_swing
from controlmm.ops.swing_reference import swing_rotations_reference


def swing_rotations(
    rotations: Float[Tensor, "T J-1 6"],
    before: Float[Tensor, "T J 3"],
    after: Float[Tensor, "T J 3"],
    heading: Float[Tensor, "T 4"],
    *,
    chains: Sequence[Sequence[int]],
    backend: Backend | None = None,
) -> Float[Tensor, "T J-1 6"]:
    """Local rotations whose bones swing from ``before`` to ``after``, while twists about the bones stay.

    ``S_j`` is the shortest rotation from a bone before to the bone after, ``L_j`` the local rotation before.
    For ``i`` before ``j`` in a chain,

        A_j = A_i L_j,    B_j = S_j A_j,    the rotation after is B_i^-1 S_j A_i L_j

    where ``A_i`` and ``B_i`` of a chain's first joint are the heading: in HumanML3D arms do not hang on the
    rotations of the spine. Where no bone swings, rotations stay.

    Six numbers are the first two columns of a matrix. A decoder's are neither unit vectors nor at right
    angles; they are turned as they are, and ``A`` takes the rotation that Zhou et al. (CVPR 2019) make of
    them. Where that is none, as the first column is zero, all that follows in the chain is zero. A bone
    without a length, or opposite to itself before, makes its rotation and the next one NaN.

    Args:
        rotations: Of joints 1 to J - 1, relative to the joint before in the chain; float64.
        before: Positions of the joints that the rotations belong to; float64, any unit.
        after: Positions that the bones swing to, in the same unit and frame.
        heading: Quaternions ``(w, x, y, z)`` of any length, from the body's frame to that of the positions.
        chains: Joints of each chain from end to end, as a skeleton has them. They lead to each joint but the
            first once, always from earlier joints to later ones.
        backend: "native", "reference" or "auto"; ``None`` asks the context and the environment.

    Raises:
        TypeError: If tensors are not float64, or ``chains`` are not sequences of whole numbers.
        ValueError: If shapes or ``chains`` do not fit, or "native" was asked for and cannot run.
    """
    check_swing(rotations, before, after, heading)
    parents, starts = chain_bones(chains, before.shape[1])
    rotations, before, after, heading = (x.detach() for x in (rotations, before, after, heading))
    if rotations.numel() == 0:
        return rotations.clone()  # no bone
    if not runs_native(backend, rotations, before, after, heading):
        return swing_rotations_reference(rotations, before, after, heading, parents, starts)
    turned = rotations.clone(memory_format=torch.contiguous_format)
    core().swing_rotations(
        torch.tensor(parents), torch.tensor(starts), before.contiguous(), after.contiguous(),
        heading.contiguous(), turned,
    )  # fmt: skip
    return turned
