"""Steps for bodies that slide along their path: the first touch of editing, before targets count alone."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.generation.editing import EditingBudget
from controlmm.generation.latent_editing import edit_latents
from controlmm.generation.objective import ControlObjective
from controlmm.generation.solvers import Progress
from controlmm.generation.step_plan import slides, step_targets
from controlmm.motion.skeleton import Skeleton

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
    for, with a time budget, which is for the targets, or with other terms, which may lead elsewhere.

    Args:
        objective: Targets of the clips.
        latents: Where editing would start.
        valid: Tokens of each clip.
        budget: Of the editing that follows.
        progress: Called after every evaluation.
    """
    if (
        not budget.naturalness
        or budget.time_budget is not None
        or budget.solver == "papers"
        or objective.terms
    ):
        return latents
    rows = [
        row for row in range(len(latents)) if slides(*_clip(objective, latents, row), _skeleton(objective))
    ]
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
    for _ in range(_ROUNDS):
        targets, mask = chosen.targets.clone(), chosen.mask.clone()
        for row in range(len(rows)):
            joints, wanted, led = _clip(chosen, stepped, row)
            places = step_targets(joints, wanted, led, _skeleton(objective))
            targets[row, : len(joints)], mask[row, : len(joints)] = places
        standing = ControlObjective(chosen.decoder, targets, mask, chosen.frames, norm=chosen.norm)
        stepped = edit_latents(standing, stepped, keep, rounds, progress=progress).latents
    return latents.index_copy(0, torch.tensor(rows), stepped)


def _clip(
    objective: ControlObjective, latents: Float[Tensor, "B L C"], row: int
) -> tuple[Float[Tensor, "T J 3"], Float[Tensor, "T J 3"], Bool[Tensor, "T J 3"]]:
    """Joints, targets and mask of one clip, decoded by itself: plans must not depend on the batch."""
    decoder, frames = objective.decoder, int(objective.frames[row].sum())
    alone = latents[row : row + 1, : frames // decoder.downsample]
    joints = decoder(alone, objective.frames[row : row + 1, :frames])[0]
    return joints, objective.targets[row, :frames], objective.mask[row, :frames]


def _skeleton(objective: ControlObjective) -> Skeleton:
    return objective.decoder.normalizer.skeleton
