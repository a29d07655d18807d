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
    share_of: int | None = None,
) -> tuple[Int[Tensor, "B L"], Bool[Tensor, "B L"]]:
    """Hide a random share ``cos(pi u / 2)`` of each clip's tokens, u uniform.

    Args:
        ids: Codes.
        valid: Positions of each clip (a prefix).
        codebook_size: Random codes are drawn from so many.
        mask_id: Id of MASK.
        pad_id: Id of PAD.
        share_of: Of how many positions the share is taken; ``None``: of the clip's own. The published code
            takes it of the padded sequence (49) and hides those of the chosen that belong to the clip, so
            that few or none of a short clip's tokens may be hidden.

    Returns:
        The corrupted ids (PAD outside ``valid``) and the chosen positions.
    """
    share = torch.cos(0.5 * math.pi * torch.rand(len(ids)))
    if share_of is None:
        rank = torch.rand(ids.shape).masked_fill(~valid, 2.0).argsort(1).argsort(1)
        count = (share * valid.sum(1)).round().clamp(min=1)
    else:
        rank = torch.rand(len(ids), max(share_of, ids.shape[1])).argsort(1).argsort(1)[:, : ids.shape[1]]
        count = (share * share_of).round().clamp(min=1)
    chosen = (rank < count[:, None]) & valid
    is_random = chosen & (torch.rand(ids.shape) < _RANDOM_SHARE)
    is_masked = chosen & ~is_random & (torch.rand(ids.shape) < _MASK_SHARE)
    corrupted = torch.where(is_random, torch.randint(codebook_size, ids.shape), ids)
    corrupted = torch.where(is_masked, mask_id, corrupted)
    return torch.where(valid, corrupted, pad_id), chosen
