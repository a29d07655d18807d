"""TLControl's motions with what its tables say beside them: the prediction's error, the optimiser's work."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.evaluation.control_errors import control_errors
from controlmm.evaluation.motion_sources import Batch, Generated
from controlmm.models.rvq_vae import frame_mask
from controlmm.pipelines.tlcontrol import TLControl
from controlmm.pipelines.tlcontrol_presets import TLControlPreset

FEEDFORWARD, ITERATIONS, EVALUATIONS = "feedforward", "iterations", "evaluations"


class OptimizedCodes(Generated):
    """As :class:`Generated`, and counts, clip by clip.

    ``feedforward``: metres off before the optimisation; ``iterations`` of L-BFGS; ``evaluations`` of the
    objective.
    """

    pipeline: TLControl
    preset: TLControlPreset

    def __init__(self, pipeline: TLControl, preset: TLControlPreset) -> None:
        super().__init__(pipeline, preset)

    def describe(self) -> dict[str, Any]:
        """See :class:`MotionSource`."""
        return {**super().describe(), "watched": [FEEDFORWARD, ITERATIONS, EVALUATIONS]}

    def latents(self, batch: Batch) -> tuple[Float[Tensor, "B L C"], dict[str, Float[Tensor, "B"]]]:
        """See :class:`Generated`; every clip must have targets."""
        predicted = self.generated(batch, replace(self.preset, iterations=0))
        decoder = self.pipeline.decoder
        padded = predicted.shape[1] * decoder.downsample
        lengths = torch.tensor([self.pipeline.padded_frames(length) for length in batch.lengths.tolist()])
        frames = frame_mask(lengths, padded)
        targets, mask = batch.joints[:, :padded], batch.mask[:, :padded]
        solution = self.pipeline.optimize(
            predicted,
            frames[:, :: decoder.downsample],
            targets,
            mask[..., None].expand_as(targets),
            self.preset,
        )
        metres = self.pipeline.skeleton.metres
        errors = control_errors(metres * decoder(predicted, frames), metres * targets, mask)
        assert solution.iterations is not None  # L-BFGS counts them
        numbers = {
            FEEDFORWARD: errors.average,
            ITERATIONS: solution.iterations.float(),
            EVALUATIONS: solution.evaluations.float(),
        }
        return solution.latents, numbers
