"""Joints put on targets and bones given their lengths, for one clip in double precision, without gradients.

Source of the projection: ProjFlow (CVPR 2026), which has ``10 L + 1`` in every frame alone; time is ours.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.ops.backend import Backend, core, runs_native
from controlmm.ops.exact_checks import check_clip, check_effort, check_lengths, check_positive, joint_flags
from controlmm.ops.exact_reference import (
    frame_bones_reference,
    project_change_reference,
    smooth_bones_reference,
)
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


def project_change(
    change: Float[Tensor, "T J 3"],
    held: Bool[Tensor, "T J 3"],
    planted: Bool[Tensor, "T J"],
    *,
    parents: Sequence[int],
    backend: Backend | None = None,
) -> Float[Tensor, "T J 3"]:
    """The smallest smooth change of a clip that is ``change`` where coordinates are held.

    Small is, for each axis with the Laplacian ``L`` of the tree of bones and second differences ``D`` in
    time, ``x^T (10 L + 1) x + 100 |D x|^2``, and 10^4 times the squares by which planted joints change from
    one frame to the next. An axis without held coordinates does not change.

    Args:
        change: Float64; read where ``held``.
        held: Whose change is known.
        planted: Joints that stand in this frame and the next.
        parents: Of each joint, -1 for the root, which comes first; parents before their children.
        backend: "native", "reference" or "auto"; ``None`` asks the context and the environment.

    Raises:
        TypeError: If ``change`` is not float64.
        ValueError: If shapes or ``parents`` do not fit, or "native" was asked for and cannot run.
    """
    check_clip("change", change, held, planted, parents)
    change = change.detach()
    if len(change) == 0:
        return change.clone()
    if not runs_native(backend, change):
        return project_change_reference(change, held, planted, parents)
    result = change.clone(memory_format=torch.contiguous_format)
    core().project_change(
        torch.tensor(parents), held.contiguous(), planted.contiguous(),
        STIFFNESS, SMOOTHNESS, STANDING, result,
    )  # fmt: skip
    return result


def smooth_bones(
    joints: Float[Tensor, "T J 3"],
    lengths: Float[Tensor, "J"],
    held: Bool[Tensor, "T J 3"],
    planted: Bool[Tensor, "T J"],
    *,
    parents: Sequence[int],
    feet: Sequence[int],
    toes: Sequence[int],
    enough: float,
    steps: int,
    backend: Backend | None = None,
) -> Float[Tensor, "T J 3"]:
    """Joints near a clip's whose bones have their lengths, all frames together: they help each other.

    Minimises over the joints ``x``, with ``d = x - joints``,

        d^T (10 L + 1) d + 10^3 |d|^2 (feet) + 100 |d_{t+1} - d_t|^2 + 10^5 (|bone| - length)^2
        + 10^4 |d_{t+1} - d_t|^2 (planted ankles) + 10^4 |x_{t+1} - x_t|^2 (planted toes)

    by Gauss-Newton steps that are damped by ``3 10^3 |step|^2``. Frames meet only their neighbours: the twin
    finds a step by one sweep through the clip and one back, the kernel by conjugate gradients between frames,
    to fourteen digits.

    Args:
        joints: Positions, float64.
        lengths: Of the bone from every joint to its parent; that of the root is not used.
        held: Coordinates that stay.
        planted: Joints that stand in this frame and the next.
        parents: As in :func:`project_change`.
        feet: Joints of the feet.
        toes: Those about which a standing foot turns.
        enough: Error of the worst bone at which to stop, in the unit of ``joints``.
        steps: At most so many.
        backend: As in :func:`project_change`.

    Raises:
        TypeError: If ``joints`` or ``lengths`` are not float64.
        ValueError: If shapes, ``parents`` or indices of joints do not fit, ``enough`` is not positive,
            ``steps`` is negative, or "native" was asked for and cannot run.
    """
    check_clip("joints", joints, held, planted, parents)
    check_lengths(lengths, parents)
    check_effort(enough, steps)
    is_foot, is_toe = joint_flags("feet", feet, parents), joint_flags("toes", toes, parents)
    joints, lengths = joints.detach(), lengths.detach()
    if len(joints) == 0 or len(parents) == 1:
        return joints.clone()  # no bone
    if not runs_native(backend, joints, lengths):
        return smooth_bones_reference(
            joints, lengths, held, planted, parents, is_foot, is_toe, enough=enough, steps=steps
        )
    start = joints.contiguous()
    moved = start.clone()
    core().smooth_bones(
        torch.tensor(parents), start, lengths.contiguous(), held.contiguous(), planted.contiguous(),
        is_foot, is_toe, STIFFNESS, FOOT_RESISTANCE, STEADINESS, STANDING, BONES, DAMPING, LATER_DAMPING,
        enough, steps, moved,
    )  # fmt: skip
    return moved


def frame_bones(
    joints: Float[Tensor, "T J 3"],
    lengths: Float[Tensor, "J"],
    held: Bool[Tensor, "T J 3"],
    planted: Bool[Tensor, "T J"],
    *,
    parents: Sequence[int],
    feet: Sequence[int],
    enough: float,
    steps: int,
    metre: float = 1.0,
    backend: Backend | None = None,
) -> Float[Tensor, "T J 3"]:
    """Joints near a clip's whose bones have their lengths, each frame for itself.

    Newton's method on the constraints: each step is the one that is smallest by ``10 L + 1``, 10^3 for feet
    and 10^4 for planted joints, and moves no coordinate by more than 5 cm. Frames that need more than half of
    the steps take the others with 10^4 more for all joints: a leg nearly straight swings about while its foot
    is heavier than its knee. Where bones cannot span what is held, lengths stay wrong.

    Args:
        joints: Positions, float64.
        lengths: As in :func:`smooth_bones`.
        held: Coordinates that stay.
        planted: Joints that stand in this frame and the next.
        parents: As in :func:`project_change`.
        feet: Joints of the feet.
        enough: Error of the worst bone at which a frame is done, in the unit of ``joints``.
        steps: At most so many a frame, an even number.
        metre: In the unit of ``joints``.
        backend: As in :func:`project_change`.

    Raises:
        TypeError: If ``joints`` or ``lengths`` are not float64.
        ValueError: If shapes, ``parents`` or indices of joints do not fit, ``enough`` is not positive,
            ``steps`` is negative or odd, ``metre`` is not positive, or "native" was asked for and cannot run.
    """
    check_clip("joints", joints, held, planted, parents)
    check_lengths(lengths, parents)
    check_effort(enough, steps)
    if steps % 2:
        raise ValueError(f"`steps` must be even, since the second half is taken in another way, got {steps}.")
    check_positive("metre", metre)
    is_foot = joint_flags("feet", feet, parents)
    joints, lengths = joints.detach(), lengths.detach()
    if len(joints) == 0 or len(parents) == 1:
        return joints.clone()  # no bone
    if not runs_native(backend, joints, lengths):
        return frame_bones_reference(
            joints, lengths, held, planted, parents, is_foot, enough=enough, steps=steps, metre=metre
        )
    moved = joints.clone(memory_format=torch.contiguous_format)
    core().frame_bones(
        torch.tensor(parents), lengths.contiguous(), held.contiguous(), planted.contiguous(),
        is_foot, STIFFNESS, FOOT_RESISTANCE, STANDING, SLACK, enough, LONGEST * metre, steps, moved,
    )  # fmt: skip
    return moved
