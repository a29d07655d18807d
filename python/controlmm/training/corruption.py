"""Masking of tokens in training (BERT-style, MoMask section 3.2)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Int
from torch import Tensor

_RANDOM_SHARE = 0.10  # of the chosen positions get a random code
_MASK_SHARE = 0.88  # of the other chosen positions become MASK; the rest keep their code


def corrupt_tokens(
    ids: Int[Tensor, "B L"],
    valid: Bool[Tensor, "B L"],
    *,
    codebook_size: int,
    mask_id: int,
    pad_id: int,
) -> tuple[Int[Tensor, "B L"], Bool[Tensor, "B L"]]:
    """Hide a random share ``cos(pi u / 2)`` of each clip's tokens, u uniform.

    The share is taken of the clip's own length; the published code takes it of the padded length, so that its
    short clips are masked at random with less spread.

    Returns:
        The corrupted ids (PAD outside ``valid``) and the chosen positions.
    """
    lengths = valid.sum(1)
    share = torch.cos(0.5 * math.pi * torch.rand(len(ids)))
    count = (share * lengths).round().clamp(min=1)
    order = (
        torch.rand(ids.shape).masked_fill(~valid, 2.0).argsort(1).argsort(1)
    )  # random rank of every position
    chosen = (order < count[:, None]) & valid
    is_random = chosen & (torch.rand(ids.shape) < _RANDOM_SHARE)
    is_masked = chosen & ~is_random & (torch.rand(ids.shape) < _MASK_SHARE)
    corrupted = torch.where(is_random, torch.randint(codebook_size, ids.shape), ids)
    corrupted = torch.where(is_masked, mask_id, corrupted)
    return torch.where(valid, corrupted, pad_id), chosen
