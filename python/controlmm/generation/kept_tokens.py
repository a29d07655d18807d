"""Tokens of a motion that is there, which decoding leaves as they are."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_CERTAIN = 1e4  # logit; noise and the steps of logits editing are some units


@dataclass(frozen=True, eq=False)
class KeptTokens:
    """Tokens that stay.

    Attributes:
        ids: (B, L, Q) codes of all layers; only those that stay count.
        where: (B, L) which stay.
    """

    ids: Int[Tensor, "B L Q"]
    where: Bool[Tensor, "B L"]

    def certain(self, logits: Float[Tensor, "B L K"]) -> Float[Tensor, "B L K"]:
        """Base logits that leave no doubt about what stays: draws, mixtures and editing give that code."""
        sure = torch.zeros_like(logits).scatter(-1, self.ids[..., :1].clamp(min=0), _CERTAIN)
        return torch.where(self.where[..., None], sure, logits)

    def put_back(self, ids: Int[Tensor, "B L Q"]) -> Int[Tensor, "B L Q"]:
        """Codes of all layers with those that stay in their places."""
        return torch.where(self.where[..., None], self.ids, ids)

    def select(self, clips: Int[Tensor, " N"]) -> KeptTokens:
        """The same for some of the clips."""
        return KeptTokens(self.ids[clips], self.where[clips])
