"""From a request to latents: ControlMM's networks in their turn, before any latents are edited."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Int
from torch import Tensor

from controlmm.generation.controlled_layers import ControlledLayers
from controlmm.generation.decoding_request import DecodingRequest
from controlmm.generation.logits_editing import LogitsEditing
from controlmm.generation.masked_decoding import (
    decode_from_text,
    decode_with_control,
    fill_residual_layers,
    final_base_ids,
    final_latents,
)
from controlmm.generation.objective import ControlObjective
from controlmm.models.control_branch import ControlBranch
from controlmm.pipelines.presets import Preset

if TYPE_CHECKING:
    from controlmm.pipelines.controlmm import ControlMM


def drawn_latents(
    pipeline: ControlMM,
    request: DecodingRequest,
    objective: ControlObjective,
    branch: ControlBranch | None,
    preset: Preset,
) -> Float[Tensor, "B L C"]:
    """Latents before they are edited; a ``branch`` and logits editing take them towards targets."""
    if branch is None and not preset.budget.logits_iterations:
        return latents_from_text(pipeline, request, preset)
    editing = LogitsEditing(objective, pipeline.decoder.tokenizer, request, preset.budget)
    logits = decode_with_control(
        pipeline.packed(pipeline.transformer, request.dtype),
        None if branch is None else pipeline.packed(branch, request.dtype),
        pipeline.decoder,
        objective,
        request,
        editing=editing,
    )
    base_ids = final_base_ids(logits, request)
    control = None
    if branch is not None and pipeline.residual_control is not None:
        base = final_latents(pipeline.decoder.tokenizer, logits, base_ids[..., None], request)
        control = ControlledLayers(
            pipeline.packed(pipeline.residual_control, request.dtype),
            pipeline.decoder,
            objective.targets,
            objective.mask,
            base,
            request.kept,
            strength=pipeline.guidance.control,
        ).quick(objective.frames, request.dtype)
    ids = _all_layers(pipeline, base_ids, request, preset, control)
    if editing.ends_with_all_layers:
        logits = editing.with_all_layers(logits, ids)
        ids = _put_back(torch.cat([final_base_ids(logits, request)[..., None], ids[..., 1:]], -1), request)
    return final_latents(pipeline.decoder.tokenizer, logits, ids, request)


def latents_from_text(
    pipeline: ControlMM, request: DecodingRequest, preset: Preset
) -> Float[Tensor, "B L C"]:
    """Latents that follow the text alone."""
    base_ids = decode_from_text(pipeline.packed(pipeline.transformer, request.dtype), request)
    ids = _all_layers(pipeline, base_ids, request, preset)
    latents: Tensor = pipeline.decoder.tokenizer.quantizer.lookup(ids)
    return latents


def _all_layers(
    pipeline: ControlMM,
    base_ids: Int[Tensor, "B L"],
    request: DecodingRequest,
    preset: Preset,
    control: ControlledLayers | None = None,
) -> Int[Tensor, "B L Q"]:
    """All layers of codes: those of tokens that are kept, the others from the residual transformer."""
    ids = fill_residual_layers(
        pipeline.packed(pipeline.residual, request.dtype),
        base_ids,
        request,
        guidance_scale=pipeline.guidance.under(preset).residual,
        control=control,
    )
    return _put_back(ids, request)


def _put_back(ids: Int[Tensor, "B L Q"], request: DecodingRequest) -> Int[Tensor, "B L Q"]:
    """With the tokens of a motion that stays."""
    return ids if request.kept is None else request.kept.put_back(ids)
