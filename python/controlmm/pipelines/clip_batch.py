"""A batch of clips of any texts, lengths and targets on its way through ControlMM."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.generation.decoding_request import DecodingRequest
from controlmm.generation.latent_editing import edit_latents
from controlmm.generation.noise import ClipNoise
from controlmm.generation.objective import ControlObjective
from controlmm.generation.one_thread import allowed_threads
from controlmm.generation.planted_feet import with_planted_feet
from controlmm.generation.solvers import Progress
from controlmm.generation.stepping import with_steps
from controlmm.generation.terms import JointTerm, is_callers
from controlmm.models.control_branch import ControlBranch
from controlmm.pipelines.presets import Preset
from controlmm.pipelines.token_drawing import drawn_latents, latents_from_text

if TYPE_CHECKING:
    from controlmm.pipelines.controlmm import ControlMM

_CONTROLLED, _FREE = 3.0, 1.0  # what a frame costs with targets and without


@dataclass(frozen=True, eq=False)
class ClipBatch:
    """Clips, padded to the longest.

    Attributes:
        text: (B, E) the text encoder's pooled vectors.
        valid: (B, L) tokens of each clip.
        targets: (B, T, J, 3) in the networks' frame, T the frames of L tokens.
        mask: (B, T, J, 3) the controlled coordinates.
        seeds: One a clip.
        terms: Minimised beside the distance to the targets.
    """

    text: Float[Tensor, "B E"]
    valid: Bool[Tensor, "B L"]
    targets: Float[Tensor, "B T J 3"]
    mask: Bool[Tensor, "B T J 3"]
    seeds: Sequence[int]
    terms: Sequence[JointTerm] = ()

    def select(self, rows: Int[Tensor, "N"]) -> ClipBatch:
        """Some of the clips, padded as they are here."""
        return ClipBatch(
            self.text[rows],
            self.valid[rows],
            self.targets[rows],
            self.mask[rows],
            [self.seeds[row] for row in rows.tolist()],
            [term.select(rows) for term in self.terms],
        )

    @property
    def is_controlled(self) -> Bool[Tensor, "B"]:
        """Which clips have targets."""
        return self.mask.flatten(1).any(1)

    @property
    def costs(self) -> list[float]:
        """What each clip costs about, in frames without targets."""
        factors = torch.where(self.is_controlled, _CONTROLLED, _FREE)
        costs: list[float] = (self.valid.sum(1) * factors).tolist()
        return costs

    def latents(
        self, pipeline: ControlMM, preset: Preset, progress: Progress | None
    ) -> Float[Tensor, "B L C"]:
        """See ``ControlMM.generate_latents``."""
        latents = torch.zeros(*self.valid.shape, pipeline.tokenizer.config.code_dim)
        is_controlled = self.is_controlled
        for wanted, make in ((~is_controlled, _free_latents), (is_controlled, _controlled_latents)):
            rows = wanted.nonzero()[:, 0]
            if len(rows):
                latents[rows] = make(self.select(rows), pipeline, preset, progress)
        return latents

    def request(self, pipeline: ControlMM, preset: Preset, progress: Progress | None) -> DecodingRequest:
        """What is asked of masked decoding."""
        scales = pipeline.guidance.under(preset)
        return DecodingRequest(
            self.text,
            self.valid,
            ClipNoise(self.seeds),
            steps=preset.steps,
            guidance_scale=scales.base,
            guided_share=scales.share,
            rules=preset.rules,
            progress=progress,
            dtype=pipeline.drawing_dtype(preset),
        )


def _free_latents(
    clips: ClipBatch, pipeline: ControlMM, preset: Preset, progress: Progress | None
) -> Float[Tensor, "B L C"]:
    """Of clips without targets: the control branch is off."""
    if clips.terms:
        return _edited(clips, None, pipeline, preset, progress)
    drawn = latents_from_text(pipeline, clips.request(pipeline, preset, progress), preset)
    strength = preset.budget.naturalness
    return with_planted_feet(pipeline.decoder, drawn, clips.valid, strength=strength, progress=progress)


def _controlled_latents(
    clips: ClipBatch, pipeline: ControlMM, preset: Preset, progress: Progress | None
) -> Float[Tensor, "B L C"]:
    return _edited(clips, pipeline.control, pipeline, preset, progress)


def _edited(
    clips: ClipBatch,
    branch: ControlBranch | None,
    pipeline: ControlMM,
    preset: Preset,
    progress: Progress | None,
) -> Float[Tensor, "B L C"]:
    """Drawn, and moved towards targets and terms."""
    objective = ControlObjective(
        pipeline.decoder,
        clips.targets,
        clips.mask,
        clips.valid.repeat_interleave(pipeline.decoder.downsample, dim=1),
        norm=preset.control_norm,
        terms=clips.terms,
    )
    drawn = drawn_latents(pipeline, clips.request(pipeline, preset, progress), objective, branch, preset)
    budget = preset.latent_budget(has_terms=bool(clips.terms))
    drawn = with_steps(objective, drawn, clips.valid, budget, progress=progress)
    keep = clips.valid[..., None].float()
    return edit_latents(objective, drawn, keep, budget, progress=progress).latents


def share_count(preset: Preset, terms: Sequence[JointTerm]) -> int:
    """Into how many shares a batch may go. A time budget and a caller's function are for all of it."""
    is_whole = preset.budget.time_budget is not None or any(is_callers(term) for term in terms)
    return 1 if is_whole else allowed_threads()
