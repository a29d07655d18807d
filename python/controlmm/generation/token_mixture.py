"""Soft tokens: weights of the codes at every position, differentiable in the logits."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def token_mixture(
    logits: Float[Tensor, "B L K"], noise: Float[Tensor, "B L K"] | None = None, *, as_printed: bool = False
) -> Float[Tensor, "B L K"]:
    """Weights ``softmax(logits + noise)``, which sum to 1 (ControlMM, equations 3 and 10).

    Args:
        logits: Unnormalised log-probabilities.
        noise: Gumbel noise; ``None`` for none.
        as_printed: Leave the noise out of the denominator, as the paper prints it. Weights then do not sum to
            1; the published code has the noise in both places.
    """
    if noise is None:
        return logits.softmax(-1)
    if as_printed:
        return torch.exp(logits + noise - logits.logsumexp(-1, keepdim=True))
    return (logits + noise).softmax(-1)
