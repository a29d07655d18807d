"""The end of a call: joints put on their targets in closed form, bones of the right length."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.generation.exact import ExactReport, all_meet_exactly
from controlmm.motion.skeleton import Skeleton


def close_clips(
    features: Float[Tensor, "B T D"],
    targets: Float[Tensor, "B T J 3"],
    mask: Bool[Tensor, "B T J 3"],
    lengths: Sequence[int],
    skeleton: Skeleton,
    *,
    bones: Float[Tensor, "J"] | None = None,
) -> tuple[ExactReport, ...]:
    """Let clips meet their targets exactly, with whole bones; writes into ``features``.

    Args:
        features: De-normalised, of motions that are near their targets.
        targets: In the networks' frame, the skeleton's unit.
        mask: The controlled coordinates; may be empty, bones are restored all the same.
        lengths: Frames of each clip.
        skeleton: Whose bones.
        bones: Other lengths of the bones, of a body that is there already.
    """
    clips = [(features[row, :end], targets[row, :end], mask[row, :end]) for row, end in enumerate(lengths)]
    reports = []
    for row, (met, report) in enumerate(all_meet_exactly(clips, skeleton, bones=bones)):
        features[row, : lengths[row]] = met
        reports.append(report)
    return tuple(reports)
