"""How long a motion should be when the caller does not say."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.controls import Control
from controlmm.models.length_estimator import LengthEstimator
from controlmm.motion.skeleton import Skeleton
from controlmm.pipelines.checks import MIN_FRAMES

_SHORT_SECONDS = 1.5  # a drawn length below is more often a slip of the estimator than what was meant


def draw_frames(
    estimator: LengthEstimator,
    text: Float[Tensor, "1 E"],
    *,
    controls: Sequence[Control],
    skeleton: Skeleton,
    max_frames: int,
    downsample: int,
    seed: int,
) -> int:
    """A length in frames, drawn from the estimator's distribution; long enough for every control.

    Warns when it is very short.

    Args:
        estimator: Text to a distribution of token counts.
        text: The prompt's vector.
        controls: Their last frame is the least that is drawn.
        skeleton: Of the motion.
        max_frames: The longest motion.
        downsample: Frames for each token.
        seed: Same seed, same length.
    """
    least = max([MIN_FRAMES, *(frames_needed(control, skeleton) for control in controls)])
    logits = estimator(text)[0]
    frames = torch.arange(len(logits)) * downsample
    is_usable = (frames >= least) & (frames <= max_frames)
    if not is_usable.any():
        return least
    probabilities = logits.where(is_usable, -torch.inf).softmax(0)
    generator = torch.Generator().manual_seed(seed)
    drawn = int(frames[torch.multinomial(probabilities, 1, generator=generator)])
    if drawn < _SHORT_SECONDS * skeleton.fps:
        warnings.warn(
            f"The length estimator drew {drawn / skeleton.fps:.1f} s for this prompt, which is very short. "
            "Pass `seconds` to choose the length yourself, or another `seed`.",
            stacklevel=5,
        )
    return drawn


def frames_needed(control: Control, skeleton: Skeleton) -> int:
    """Frames of the shortest motion that can follow ``control``."""
    return int(control.sample(MIN_FRAMES, skeleton).frames.max()) + 1
