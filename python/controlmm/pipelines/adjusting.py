"""Moving the targets of a motion that is there: editing that starts from the last result."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from controlmm.controls import Control, densify
from controlmm.generation.control_residuals import ControlResiduals
from controlmm.generation.solvers import Stopping, gauss_newton
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.placement import moved
from controlmm.pipelines.scene import Scene

if TYPE_CHECKING:
    from controlmm.generation.motion_decoder import MotionDecoder

_ITERATIONS = 40


def adjusted(
    decoder: MotionDecoder,
    result: GenerationResult,
    controls: Sequence[Control],
    *,
    hold_frames: int,
    tolerance: float,
) -> GenerationResult:
    """See :meth:`controlmm.pipelines.ControlMM.adjust`."""
    started = time.perf_counter()
    _check(result, hold_frames=hold_frames, tolerance=tolerance)
    motion = result.motions[0]
    frames, skeleton = motion.num_frames, decoder.normalizer.skeleton
    dense = densify(controls, frames, skeleton)
    origin = motion.joints[0, 0] * motion.joints.new_tensor([1, 0, 1])
    scene = Scene(motion.text, frames, dense, origin)
    canonical, count = moved(dense, -origin), len(result)
    padded = result.latents.shape[1] * decoder.downsample
    targets, mask = (
        torch.nn.functional.pad(x.expand(count, -1, -1, -1), (0, 0, 0, 0, 0, padded - frames))
        for x in (canonical.targets, canonical.mask)
    )
    keep = torch.ones(count, result.latents.shape[1], 1)
    keep[:, : -(-hold_frames // decoder.downsample)] = 0
    residuals = ControlResiduals(
        decoder,
        targets,
        mask,
        torch.ones(count, padded, dtype=torch.bool),
        prefix=result.latents if hold_frames else None,
        prefix_frames=hold_frames,
    )
    stopping = Stopping(iterations=_ITERATIONS, error=tolerance)
    solution = gauss_newton(residuals, result.latents, keep, stopping)
    features = decoder.clip_features(solution.latents)[:, :frames]
    features[:, :hold_frames] = decoder.clip_features(result.latents)[:, :hold_frames]
    return scene.result(features, solution.latents, seconds_taken=time.perf_counter() - started)


def _check(result: GenerationResult, *, hold_frames: int, tolerance: float) -> None:
    if not isinstance(result, GenerationResult):
        raise TypeError(
            f"`result` must be what a call of the pipeline returned, got {type(result).__name__}."
        )
    frames = result.motions[0].num_frames
    if isinstance(hold_frames, bool) or not isinstance(hold_frames, int) or not 0 <= hold_frames < frames:
        raise ValueError(f"`hold_frames` must be a whole number from 0 to {frames - 1}, got {hold_frames!r}.")
    if not tolerance > 0:
        raise ValueError(f"`tolerance` must be a positive number of metres, got {tolerance!r}.")
