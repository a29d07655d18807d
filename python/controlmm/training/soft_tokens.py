"""Tokens drawn in training, and what takes their place to be differentiable (ControlMM, equation 3)."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from controlmm.generation.token_mixture import token_mixture
from controlmm.ops import gumbel_noise, gumbel_straight_through

Sampling = Literal["softmax", "gumbel", "gumbel_st", "gumbel_as_printed"]


def mixed_codes(
    logits: Float[Tensor, "B L K"], codes: Float[Tensor, "K C"], sampling: Sampling
) -> Float[Tensor, "B L C"]:
    """Code vectors that the logits stand for, differentiable in the logits. Noise from the global state.

    Args:
        logits: Of the base codes.
        codes: Base codebook.
        sampling: ``softmax``: the mean code (published training). ``gumbel``: the mean under logits with
            Gumbel noise. ``gumbel_st``: the code drawn, with the gradient of ``gumbel`` (the paper).
            ``gumbel_as_printed``: equation 3 to the letter, without the noise in the denominator.
    """
    if sampling == "softmax":
        return token_mixture(logits) @ codes
    seed = int(torch.randint(2**62, ()))
    if sampling == "gumbel_as_printed":
        batch, tokens, count = logits.shape
        noise = gumbel_noise((batch, tokens, count), seed=seed, dtype=logits.dtype)
        return token_mixture(logits, noise, as_printed=True) @ codes
    return gumbel_straight_through(logits, codes, seed=seed, hard=sampling == "gumbel_st")[0]


def drawn_ids(logits: Float[Tensor, "B L K"]) -> Int[Tensor, "B L"]:
    """A code for every token, from the distribution that the logits stand for."""
    noise = torch.empty_like(logits, dtype=torch.float32).exponential_().clamp_(min=1e-30).log_().neg_()
    return (logits.float() + noise).argmax(-1)
