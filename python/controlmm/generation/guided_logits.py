"""Logits of the masked and the residual transformer, guided by the text (classifier-free guidance).

Clips are predicted at their own length, a few of one length at a time, with and without their text in one
call.
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

# (clips, which may be named twice; how many tokens; a text for each) -> logits of these clips and tokens
Prediction = Callable[[Int[Tensor, "N"], int, Float[Tensor, "N E"]], Float[Tensor, "N L K"]]


def base_prediction(base: MaskedTransformer, embedded: Float[Tensor, "B L E"]) -> Prediction:
    """What ``base`` makes of the tokens of a batch."""

    def predict(rows: Tensor, length: int, text: Tensor) -> Tensor:
        logits: Tensor = base(embedded[rows, :length], text, _all_valid(rows, length))
        return logits

    return predict


def controlled_prediction(
    base: MaskedTransformer,
    branch: ControlBranch,
    embedded: Float[Tensor, "B L E"],
    hint: Float[Tensor, "B S W"],
) -> Prediction:
    """What ``base`` makes of them with the :meth:`ControlBranch.hint` of each clip."""

    def predict(rows: Tensor, length: int, text: Tensor) -> Tensor:
        sequence = base.sequence(embedded[rows, :length], text)
        hints = hint[rows, : sequence.shape[1]]
        return branch.hinted_logits(base, sequence, hints, _all_valid(rows, length))

    return predict


def residual_prediction(
    residual: ResidualTransformer,
    history: Float[Tensor, "B L E"],
    layer: Int[Tensor, "B"],
    hints: Sequence[Float[Tensor, "B L W"]] | None,
) -> Prediction:
    """What ``residual`` makes of the layers before ``layer``."""

    def predict(rows: Tensor, length: int, text: Tensor) -> Tensor:
        own = None if hints is None else [hint[rows, :length] for hint in hints]
        valid = _all_valid(rows, length)
        logits: Tensor = residual(history[rows, :length], layer[rows], text, valid, hints=own)
        return logits

    return predict


def _all_valid(rows: Int[Tensor, "N"], length: int) -> Bool[Tensor, "N L"]:
    """The mask of clips without padding."""
    return torch.ones(len(rows), length, dtype=torch.bool)


def guided(
    predict: Prediction, request: DecodingRequest, *, scale: float | None = None
) -> Float[Tensor, "B L K"]:
    """Classifier-free guidance: ``l_0 + s (l_text - l_0)``, where "no text" is the zero vector.

    Zero in padding, which no network sees: a clip is predicted at its own length.
    """
    scale = request.guidance_scale if scale is None else scale
    whole: Tensor | None = None
    for length, rows in request.groups:
        text = request.text[rows]
        if scale == 1:
            logits = predict(rows, length, text)
        else:
            both = predict(rows.repeat(2), length, torch.cat([text, torch.zeros_like(text)]))
            with_text, without = both.chunk(2)
            logits = without + scale * (with_text - without)
        if whole is None:
            whole = logits.new_zeros(*request.valid.shape, logits.shape[-1])
        whole[rows, :length] = logits
    assert whole is not None  # a request has clips
    return whole
