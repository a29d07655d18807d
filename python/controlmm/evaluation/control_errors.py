"""Trajectory, location and average error of controlled joints.

Sources: Karunratanakul et al., GMD, ICCV 2023; Xie et al., OmniControl, ICLR 2024; Pinyoanuntapong et al.,
ControlMM / MaskControl, ICCV 2025.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Rule = Literal["joint", "frame"]
THRESHOLDS = (0.2, 0.5)  # metres; the papers' tables show 50 cm


@dataclass(frozen=True, eq=False)
class ControlErrors:
    """Errors of every clip; a clip without targets has NaN, for there is nothing to fail at.

    Attributes:
        trajectory: For each threshold, (B,): 1 if any elementary error is above it, else 0.
        location: For each threshold, (B,): share of elementary errors above it.
        average: (B,) mean elementary error in metres.
    """

    trajectory: Mapping[float, Float[Tensor, "B"]]
    location: Mapping[float, Float[Tensor, "B"]]
    average: Float[Tensor, "B"]


def control_errors(
    joints: Float[Tensor, "B T J 3"],
    targets: Float[Tensor, "B T J 3"],
    mask: Bool[Tensor, "B T J"],
    *,
    rule: Rule = "joint",
    thresholds: tuple[float, ...] = THRESHOLDS,
) -> ControlErrors:
    """Errors of each clip from its elementary errors; averages over clips weigh all clips alike.

    ``rule="joint"`` (OmniControl): an elementary error is the distance of one controlled joint in one frame.
    ``rule="frame"`` (MaskControl): the mean of those over the joints controlled in that frame, taken before
    thresholds are applied. With several joints the second is more lenient: one joint may miss by far if
    another one is near. With one joint the two are the same.

    An error of exactly the threshold passes. Every error is a true mean over the entries of the mask: not
    divided by the coordinates once more, as one public scorer does (which gives a third).

    Args:
        joints: Global positions in metres.
        targets: Wanted positions in the same frame; not looked at outside the mask.
        mask: True where a joint is controlled, all three coordinates of it.
        rule: ``"joint"`` or ``"frame"``.
        thresholds: Metres.

    Raises:
        ValueError: If shapes differ or the rule is unknown.
    """
    if joints.shape != targets.shape or tuple(mask.shape) != tuple(joints.shape[:-1]):
        raise ValueError(
            "`joints` and `targets` must be (B, T, J, 3) and `mask` (B, T, J), "
            f"got {tuple(joints.shape)}, {tuple(targets.shape)}, {tuple(mask.shape)}."
        )
    if rule not in get_args(Rule):
        raise ValueError(f"`rule` must be one of {get_args(Rule)}, got {rule!r}.")
    distance = torch.where(mask[..., None], joints.double() - targets.double(), 0.0).norm(dim=-1)
    counts = mask
    if rule == "frame":
        controlled = mask.sum(2)
        distance = distance.sum(2) / controlled.clamp(min=1)
        counts = controlled > 0
    return _per_clip(distance.flatten(1), counts.flatten(1), thresholds)


def _per_clip(
    distance: Float[Tensor, "B N"], counts: Bool[Tensor, "B N"], thresholds: tuple[float, ...]
) -> ControlErrors:
    number = counts.sum(1).double()  # 0 / 0 gives the NaN of a clip without targets
    failed = {threshold: (distance > threshold) & counts for threshold in thresholds}
    return ControlErrors(
        trajectory={t: f.any(1).double().where(number > 0, torch.nan) for t, f in failed.items()},
        location={t: f.sum(1) / number for t, f in failed.items()},
        average=distance.masked_fill(~counts, 0.0).sum(1) / number,
    )
