"""Variation: the least certain base tokens of a motion are drawn anew to a text, a few at a time."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from controlmm.generation.decoding_request import DecodingRequest
from controlmm.generation.decoding_rules import likeliest_share
from controlmm.generation.guided_logits import base_prediction, guided
from controlmm.generation.masked_decoding import DECIDED, lowest
from controlmm.models.masked_transformer import MaskedTransformer

VARIATION_STEPS = 10  # that carry a motion as far as MoMask's, however few a preset needs to draw one
VARIED_SHARE = 0.16  # of the tokens that each step draws anew: MoMask's, without an edit mask


def vary_tokens(
    base: MaskedTransformer, request: DecodingRequest, ids: Int[Tensor, "B L"]
) -> Int[Tensor, "B L"]:
    """Base tokens of a motion moved towards a text: each step draws the 16 % least certain ones anew."""
    ids = torch.where(request.valid, ids, base.pad_id)
    scores = _certainty(_logits(base, request, ids), ids).masked_fill(~request.valid, DECIDED)
    counts = (VARIED_SHARE * request.valid.sum(1)).round().long().clamp(min=1)
    for step in range(request.steps):
        hidden = lowest(scores, counts)
        logits = _logits(base, request, torch.where(hidden, base.mask_id, ids))
        allowed = likeliest_share(logits, request.rules.text_top_share)
        drawn = (allowed + request.gumbel(logits.shape[-1])).argmax(-1)
        ids, certainty = torch.where(hidden, drawn, ids), _certainty(logits, drawn)
        scores = torch.where(hidden, certainty, scores)
        request.report(step + 1, certainty)
    return torch.where(request.valid, ids, -1)


def _logits(base: MaskedTransformer, request: DecodingRequest, ids: Int[Tensor, "B L"]) -> Tensor:
    return guided(base_prediction(base, base.embed(ids)), request)


def _certainty(logits: Float[Tensor, "B L K"], ids: Int[Tensor, "B L"]) -> Float[Tensor, "B L"]:
    known = ids.clamp(max=logits.shape[-1] - 1)
    return logits.softmax(-1).gather(-1, known[..., None]).squeeze(-1)
