"""Temporal in-painting: some base tokens of a motion are drawn anew to a text (MoMask, section 3.5)."""

from __future__ import annotations

import math
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.generation.decoding_rules import likeliest_share
from controlmm.generation.masked_decoding import DECIDED, DecodingRequest, guided, lowest
from controlmm.models.masked_transformer import MaskedTransformer

RESIDUAL_GUIDANCE = 2.0  # MoMask's, for edited motions
VARIED_SHARE = 0.16  # of the tokens that each step draws anew when no section is named


def inpaint_tokens(
    base: MaskedTransformer, request: DecodingRequest, ids: Int[Tensor, "B L"], editable: Bool[Tensor, "B L"]
) -> Int[Tensor, "B L"]:
    """Base tokens with the editable ones drawn anew; the others stay and are seen by the network.

    Args:
        base: The masked transformer.
        request: Text, lengths, noise, steps.
        ids: Tokens of the source motion.
        editable: Which to draw; every clip must have one.
    """
    scores = torch.zeros(ids.shape).masked_fill(~editable, DECIDED)
    ids = torch.where(editable, base.mask_id, torch.where(request.valid, ids, base.pad_id))
    for step in range(request.steps):
        t = step / max(1, request.steps - 1)
        counts = (math.cos(0.5 * math.pi * t) * editable.sum(1)).round().long().clamp(min=1)
        hidden = lowest(scores, counts)
        ids, certainty = _drawn(base, request, ids, hidden)
        scores = torch.where(hidden, certainty, DECIDED)
        request.report(step + 1, certainty)
    return torch.where(request.valid, ids, -1)


def vary_tokens(
    base: MaskedTransformer, request: DecodingRequest, ids: Int[Tensor, "B L"]
) -> Int[Tensor, "B L"]:
    """Base tokens of a motion moved towards a text: each step draws the 16 % least certain ones anew."""
    ids = torch.where(request.valid, ids, base.pad_id)
    scores = _certainty(_logits(base, request, ids), ids).masked_fill(~request.valid, DECIDED)
    counts = (VARIED_SHARE * request.valid.sum(1)).round().long().clamp(min=1)
    for step in range(request.steps):
        hidden = lowest(scores, counts)
        ids, certainty = _drawn(base, request, ids, hidden)
        scores = torch.where(hidden, certainty, scores)
        request.report(step + 1, certainty)
    return torch.where(request.valid, ids, -1)


def _drawn(
    base: MaskedTransformer,
    request: DecodingRequest,
    ids: Int[Tensor, "B L"],
    hidden: Bool[Tensor, "B L"],
) -> tuple[Int[Tensor, "B L"], Float[Tensor, "B L"]]:
    """Tokens of which the hidden ones are drawn anew, and how certain the network is of each draw."""
    logits = _logits(base, request, torch.where(hidden, base.mask_id, ids))
    allowed = likeliest_share(logits, request.rules.text_top_share)
    drawn = (allowed + request.gumbel(logits.shape[-1])).argmax(-1)
    return torch.where(hidden, drawn, ids), _certainty(logits, drawn)


def _logits(base: MaskedTransformer, request: DecodingRequest, ids: Int[Tensor, "B L"]) -> Tensor:
    return guided(partial(base, base.embed(ids), valid=request.valid), request)


def _certainty(logits: Float[Tensor, "B L K"], ids: Int[Tensor, "B L"]) -> Float[Tensor, "B L"]:
    known = ids.clamp(max=logits.shape[-1] - 1)
    return logits.softmax(-1).gather(-1, known[..., None]).squeeze(-1)
