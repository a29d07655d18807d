"""Masked decoding: from nothing but MASK tokens to a whole motion in about ten parallel steps."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.generation.controlled_layers import ControlledLayers, without_base
from controlmm.generation.decoding_request import DecodingRequest
from controlmm.generation.decoding_rules import likeliest_share
from controlmm.generation.guided_logits import (
    base_prediction,
    controlled_prediction,
    guided,
    residual_prediction,
)
from controlmm.generation.logits_editing import LogitsEditing
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.objective import ControlObjective
from controlmm.generation.partial_decoder import PartialDecoder, controlled_joints
from controlmm.generation.token_mixture import token_mixture
from controlmm.models.control_branch import ControlBranch
from controlmm.models.masked_transformer import MaskedTransformer
from controlmm.models.residual_transformer import ResidualTransformer
from controlmm.models.tokenizer import MotionTokenizer
from controlmm.nn.row_product import row_product

DECIDED = 1e5  # confidence of tokens that are never masked again
_RESIDUAL_TOP_SHARE = 0.1  # of the codes can be drawn in residual layers that are drawn


def decode_from_text(base: MaskedTransformer, request: DecodingRequest) -> Int[Tensor, "B L"]:
    """Base tokens of motions that follow a text only (MoMask's loop); -1 in padding.

    Tokens that are kept stay, and the network sees them: temporal in-painting (MoMask, section 3.5).
    """
    valid, kept = request.valid, request.kept
    ids = torch.where(valid, base.mask_id, base.pad_id)
    if kept is not None:
        ids = torch.where(kept.where, kept.ids[..., 0], ids)
    scores = torch.zeros(valid.shape).masked_fill(~request.drawn, DECIDED)
    for step in range(request.steps):
        hidden = lowest(scores, masked_counts(request, step))
        ids = torch.where(hidden, base.mask_id, ids)
        logits = guided(base_prediction(base, base.embed(ids)), request, scale=request.guidance_in(step))
        allowed = likeliest_share(logits, request.rules.text_top_share)
        drawn = (allowed + request.gumbel(logits.shape[-1])).argmax(-1)
        ids = torch.where(hidden, drawn, ids)
        confidence = logits.softmax(-1).gather(-1, drawn[..., None]).squeeze(-1)
        scores = torch.where(hidden, confidence, DECIDED)
        request.report(step + 1, confidence)
    return torch.where(valid, ids, -1)


def decode_with_control(
    base: MaskedTransformer,
    branch: ControlBranch | None,
    decoder: MotionDecoder,
    objective: ControlObjective,
    request: DecodingRequest,
    *,
    editing: LogitsEditing | None = None,
) -> Float[Tensor, "B L K"]:
    """Final base logits of motions that follow a text and spatial targets.

    Unlike without control, tokens stay soft: every step predicts all of them anew, and the motion comes from
    the last logits, not from the ids that were drawn on the way. Those only decide where MASK is put back.
    Without a ``branch`` only logits ``editing`` follows the objective, which then need not hold targets.
    Tokens that are kept have logits that leave no doubt.
    """
    valid, codes, rules, kept = request.valid, decoder.tokenizer.base_codes, request.rules, request.kept
    keep = valid[..., None].float()
    frames = valid.repeat_interleave(decoder.downsample, dim=1)
    part = PartialDecoder(decoder, controlled_joints(objective.mask), frames, dtype=request.dtype)
    mask_embedding, mean_code = base.token_embedding.weight[base.mask_id], codes.mean(0)
    logits = torch.ones(*valid.shape, len(codes))
    embedded = mask_embedding.expand(*valid.shape, -1)
    if kept is not None:
        logits = kept.certain(logits)
        embedded = torch.where(kept.where[..., None], base.embed(kept.ids[..., 0].clamp(min=0)), embedded)
    scores = torch.zeros(valid.shape).masked_fill(~request.drawn, DECIDED)
    for step in range(request.steps):
        hidden = lowest(scores, masked_counts(request, step))[..., None]
        embedded = torch.where(hidden, mask_embedding, embedded)
        scale = request.guidance_in(step)
        if branch is None:
            logits = guided(base_prediction(base, embedded), request, scale=scale)
        else:
            latents = torch.where(hidden, mean_code, row_product(logits.softmax(-1), codes)) * keep
            signal = branch.signal(objective.targets, objective.mask, part.positions(latents))
            hint = branch.hint(signal, valid)
            logits = guided(controlled_prediction(base, branch, embedded, hint), request, scale=scale)
        if kept is not None:
            logits = kept.certain(logits)
        if editing is not None:
            logits = editing.within(logits, step)
        weights = token_mixture(likeliest_share(logits, rules.top_share), request.gumbel(len(codes)))
        embedded = base.embed_soft(weights)
        second = request.gumbel(len(codes)) if rules.noise_twice else 0.0
        drawn = (weights.log() + second).argmax(-1)
        confidence = logits.softmax(-1).gather(-1, drawn[..., None]).squeeze(-1)
        scores = torch.where(hidden[..., 0], confidence, DECIDED)
        request.report(step + 1, confidence)
    return logits


def fill_residual_layers(
    residual: ResidualTransformer,
    base_ids: Int[Tensor, "B L"],
    request: DecodingRequest,
    *,
    guidance_scale: float = 5.0,
    control: ControlledLayers | None = None,
) -> Int[Tensor, "B L Q"]:
    """All layers of codes, by default the most likely one in each residual layer.

    With ``control`` each layer makes up for what the ones before it miss of the targets. -1 in padding, and
    where "no code" wins if the rules let it.
    """
    layers = [base_ids]
    for layer in range(1, residual.config.num_quantizers):
        number = torch.full((len(base_ids),), layer)
        missing = torch.full_like(base_ids, -1)
        ids = torch.stack(layers + [missing] * (residual.config.num_quantizers - layer), dim=-1)
        history = residual.history(ids, number)
        hints = None if control is None else control.hints(ids, number, request.valid)
        predict = residual_prediction(residual, history, number, hints)
        logits = guided(predict, request, scale=guidance_scale)
        if not request.rules.pad_class:
            logits = logits[..., : residual.pad_id]  # a valid position always has a code
        if request.rules.residual_tokens == "sampled":
            logits = likeliest_share(logits, _RESIDUAL_TOP_SHARE) + request.gumbel(logits.shape[-1])
        drawn = logits.argmax(-1)
        layers.append(torch.where(request.valid & (drawn != residual.pad_id), drawn, -1))
    return torch.stack(layers, dim=-1)


def final_base_ids(logits: Float[Tensor, "B L K"], request: DecodingRequest) -> Int[Tensor, "B L"]:
    """Base codes that the last logits stand for; -1 in padding.

    The likeliest ones, or drawn ones. Where "no code" is allowed it counts as one more code with logit 0, as
    the published code has it.
    """
    if request.rules.final_tokens == "sampled":
        logits = logits + request.gumbel(logits.shape[-1])
    best, ids = logits.max(-1)
    has_code = request.valid & ((best >= 0) | (not request.rules.pad_class))
    return torch.where(has_code, ids, -1)


def final_latents(
    tokenizer: MotionTokenizer,
    logits: Float[Tensor, "B L K"],
    ids: Int[Tensor, "B L Q"],
    request: DecodingRequest,
) -> Float[Tensor, "B L C"]:
    """Where latent editing starts: residual layers are hard, the base layer is a mean of codes.

    Or hard, too, when the final tokens are drawn.
    """
    if request.rules.final_tokens == "sampled":
        return tokenizer.quantizer.lookup(ids)
    soft = row_product(token_mixture(logits), tokenizer.base_codes) * request.valid[..., None]
    return soft + tokenizer.quantizer.lookup(without_base(ids))


def masked_counts(request: DecodingRequest, step: int) -> Int[Tensor, "B"]:
    """Tokens to hide in ``step``: ``max(1, round(cos(pi t / 2) drawn))``, t from 0 to 1 inclusive."""
    t = step / max(1, request.steps - 1)
    counts = (math.cos(0.5 * math.pi * t) * request.drawn.sum(1)).round().long()
    return counts.clamp(min=1)


def lowest(scores: Float[Tensor, "B L"], counts: Int[Tensor, "B"]) -> Bool[Tensor, "B L"]:
    """True at the ``counts[b]`` lowest scores of each clip; equal scores go by position."""
    rank = scores.argsort(dim=1, stable=True).argsort(dim=1, stable=True)
    return rank < counts[:, None]
