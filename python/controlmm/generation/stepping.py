"""Steps for bodies that slide along their path: the first touch of editing, before targets count alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.generation.editing import EditingBudget
from controlmm.generation.latent_editing import edit_latents
from controlmm.generation.objective import ControlObjective
from controlmm.generation.solvers import Progress
from controlmm.generation.step_plan import slides, step_targets
from controlmm.ops import recover_joints

_ROUNDS = 2  # the second plans from what the first has reached
_ITERATIONS, _TOLERANCE = 20, 0.02  # of a round, metres
_NATURALNESS = 0.5  # times the budget's: legs must move as they did not


def with_steps(
    objective: ControlObjective,
    latents: Float[Tensor, "B L C"],
    valid: Bool[Tensor, "B L"],
    budget: EditingBudget,
    *,
    progress: Progress | None = None,
) -> Float[Tensor, "B L C"]:
    """Latents of clips that step where they would slide along their targets; the others as they are.

    Feet are given places to stand, see :mod:`controlmm.generation.step_plan`, for these rounds only: the
    editing that follows meets the targets alone. Nothing is done without naturalness, which is what steps are
    for, with a time budget, which is for the targets, or where no editing follows.

    Args:
        objective: Targets of the clips; obstacles and other terms do not count here.
        latents: Where editing would start.
        valid: Tokens of each clip.
        budget: Of the editing that follows.
        progress: Called after every evaluation, with both rounds as one phase.
    """
    is_edited = budget.latent_iterations > 0 and budget.solver != "papers"
    if not is_edited or not budget.naturalness or budget.time_budget is not None:
        return latents
    skeleton = objective.decoder.normalizer.skeleton
    rows = [row for row, clip in enumerate(_clips(objective, latents)) if slides(*clip, skeleton)]
    if not rows:
        return latents
    chosen, stepped = objective.select(torch.tensor(rows)), latents[rows]
    rounds = replace(
        budget,
        latent_iterations=_ITERATIONS,
        tolerance=_TOLERANCE,
        naturalness=_NATURALNESS * budget.naturalness,
    )
    keep = valid[rows, :, None].to(latents.dtype)
    for number in range(_ROUNDS):
        targets, mask = chosen.targets.clone(), chosen.mask.clone()
        for row, clip in enumerate(_clips(chosen, stepped)):
            inside = slice(0, len(clip[0]))
            targets[row, inside], mask[row, inside] = step_targets(*clip, skeleton)
        standing = ControlObjective(chosen.decoder, targets, mask, chosen.frames, norm=chosen.norm)
        stepped = edit_latents(standing, stepped, keep, rounds, progress=_of_round(number, progress)).latents
    return latents.index_copy(0, torch.tensor(rows), stepped)


def _of_round(number: int, progress: Progress | None) -> Progress | None:
    """For the editing in a round, whose steps then follow on those of the rounds before."""
    if progress is None:
        return None
    before, total = number * _ITERATIONS, _ROUNDS * _ITERATIONS
    return lambda _, done, __: progress("planned steps", before + done, total)


def _clips(
    objective: ControlObjective, latents: Float[Tensor, "B L C"]
) -> Iterator[tuple[Float[Tensor, "T J 3"], Float[Tensor, "T J 3"], Bool[Tensor, "T J 3"]]]:
    """Joints, targets and mask of each clip, on its own frames."""
    decoder = objective.decoder
    features = decoder.clip_features(latents, objective.frames)
    joints = recover_joints(features, joints=decoder.normalizer.skeleton.num_joints)
    ends = objective.frames.sum(1).tolist()
    for end, clip in zip(ends, zip(joints, objective.targets, objective.mask, strict=True), strict=True):
        yield clip[0][:end], clip[1][:end], clip[2][:end]
