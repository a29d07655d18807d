"""How sure the masked transformer is of its tokens, step by step (ControlMM, Figures 7 to 11)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.evaluation.controlmm_tables import without_control_model
from controlmm.evaluation.motion_sources import Batch, pooled_texts
from controlmm.generation.decoding_request import DecodingRequest
from controlmm.generation.decoding_rules import DecodingRules
from controlmm.generation.editing import EditingBudget
from controlmm.generation.logits_editing import LogitsEditing
from controlmm.generation.masked_decoding import decode_from_text, decode_with_control
from controlmm.generation.noise import ClipNoise
from controlmm.generation.objective import ControlObjective
from controlmm.models.rvq_vae import frame_mask
from controlmm.pipelines.controlmm import ControlMM


@dataclass(frozen=True, eq=False)
class ConfidenceRecord:
    """Probabilities of the tokens that were drawn.

    Attributes:
        label: What was in use.
        steps: (S, B, L), NaN beyond the end of a clip.
    """

    label: str
    steps: Float[Tensor, "S B L"]

    @property
    def mean(self) -> Float[Tensor, "S"]:
        """Mean over all tokens of all clips, for each step."""
        return self.steps.flatten(1).nanmean(1)

    @property
    def by_position(self) -> Float[Tensor, "S L"]:
        """Mean over clips, for each step and token."""
        return self.steps.nanmean(1)


def confidence_records(
    pipeline: ControlMM, batch: Batch, *, steps: int = 10, iterations: int = 100
) -> list[ConfidenceRecord]:
    """Text alone, then every combination of the motion control model and logits editing, on one batch.

    Args:
        pipeline: The model.
        batch: Texts, lengths and targets; the same noise in all records.
        steps: Decoding steps.
        iterations: Of logits editing in each step.
    """
    plain = without_control_model(pipeline)
    cases = (
        ("text alone", None, 0),
        ("control model off, no editing", plain, 0),
        ("control model off, logits editing", plain, iterations),
        ("control model on, no editing", pipeline, 0),
        ("control model on, logits editing", pipeline, iterations),
    )
    return [
        ConfidenceRecord(label, _watched(pipeline, model, batch, steps, count))
        for label, model, count in cases
    ]


@torch.no_grad()
def _watched(
    pipeline: ControlMM, controlled: ControlMM | None, batch: Batch, steps: int, iterations: int
) -> Float[Tensor, "S B L"]:
    tokens = batch.lengths // pipeline.decoder.downsample
    valid = frame_mask(tokens, int(tokens.max()))
    seen: list[Tensor] = []
    request = DecodingRequest(
        pooled_texts(pipeline.text_encoder, batch.samples),
        valid,
        ClipNoise(batch.noise_seeds),
        steps=steps,
        rules=DecodingRules(last_edit="base"),  # no residual layers are made here
        watch=lambda _, confidence: seen.append(confidence.masked_fill(~valid, torch.nan)),
    )
    if controlled is None:
        decode_from_text(pipeline.transformer, request)
        return torch.stack(seen)
    frames = valid.repeat_interleave(pipeline.decoder.downsample, dim=1)
    length = frames.shape[1]
    mask = batch.mask[:, :length, :, None].expand(-1, -1, -1, 3)
    objective = ControlObjective(pipeline.decoder, batch.joints[:, :length] * mask, mask, frames)
    decode_with_control(
        pipeline.transformer,
        controlled.control,
        pipeline.decoder,
        objective,
        request,
        editing=LogitsEditing(
            objective, pipeline.tokenizer, request, EditingBudget(logits_iterations=iterations)
        ),
    )
    return torch.stack(seen)


def mean_confidence(records: Sequence[ConfidenceRecord]) -> list[list[str]]:
    """Lines of a table: label, then the mean of each step."""
    return [[record.label, *(f"{value:.3f}" for value in record.mean.tolist())] for record in records]
