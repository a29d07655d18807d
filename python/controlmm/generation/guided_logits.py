"""Logits of the masked and the residual transformer, guided by the text (classifier-free guidance).

Clips of like lengths are predicted together, with and without their text in one call.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.generation.decoding_request import DecodingRequest
from controlmm.models.control_branch import ControlBranch
from controlmm.models.masked_transformer import MaskedTransformer
from controlmm.models.residual_transformer import ResidualTransformer

# (clips, which may be named twice; which tokens they have; a text for each) -> logits of these tokens
Prediction = Callable[[Int[Tensor, "N"], Bool[Tensor, "N L"], Float[Tensor, "N E"]], Float[Tensor, "N L K"]]


def base_prediction(base: MaskedTransformer, embedded: Float[Tensor, "B L E"]) -> Prediction:
    """What ``base`` makes of the tokens of a batch."""

    def predict(rows: Tensor, valid: Tensor, text: Tensor) -> Tensor:
        logits: Tensor = base(embedded[rows, : valid.shape[1]], text, valid)
        return logits

    return predict


def controlled_prediction(
    base: MaskedTransformer,
    branch: ControlBranch,
    embedded: Float[Tensor, "B L E"],
    hint: Float[Tensor, "B S W"],
) -> Prediction:
    """What ``base`` makes of them with the :meth:`ControlBranch.hint` of each clip."""

    def predict(rows: Tensor, valid: Tensor, text: Tensor) -> Tensor:
        sequence = base.sequence(embedded[rows, : valid.shape[1]], text)
        return branch.hinted_logits(base, sequence, hint[rows, : sequence.shape[1]], valid)

    return predict


def residual_prediction(
    residual: ResidualTransformer,
    history: Float[Tensor, "B L E"],
    layer: Int[Tensor, "B"],
    hints: Sequence[Float[Tensor, "B L W"]] | None,
) -> Prediction:
    """What ``residual`` makes of the layers before ``layer``."""

    def predict(rows: Tensor, valid: Tensor, text: Tensor) -> Tensor:
        longest = valid.shape[1]
        own = None if hints is None else [hint[rows, :longest] for hint in hints]
        logits: Tensor = residual(history[rows, :longest], layer[rows], text, valid, hints=own)
        return logits

    return predict


def guided(
    predict: Prediction, request: DecodingRequest, *, scale: float | None = None
) -> Float[Tensor, "B L K"]:
    """Classifier-free guidance: ``l_0 + s (l_text - l_0)``, where "no text" is the zero vector.

    Zero in padding, which is for no network to see: packed ones leave it out.
    """
    scale = request.guidance_scale if scale is None else scale
    whole: Tensor | None = None
    for rows in request.groups:
        text, longest = request.text[rows], max(request.lengths[row] for row in rows.tolist())
        valid = request.valid[rows, :longest]
        if scale == 1:
            logits = predict(rows, valid, text)
        else:
            # A clip beside itself: attention takes neighbours of one length together.
            texts = torch.stack([text, torch.zeros_like(text)], dim=1).flatten(0, 1)
            both = predict(rows.repeat_interleave(2), valid.repeat_interleave(2, dim=0), texts)
            with_text, without = both.unflatten(0, (-1, 2)).unbind(1)
            logits = without + scale * (with_text - without)
        if whole is None:
            whole = logits.new_zeros(*request.valid.shape, logits.shape[-1])
        whole[rows, :longest] = logits.where(valid[..., None], 0)
    assert whole is not None  # a request has clips
    return whole
