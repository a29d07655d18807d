"""Where ControlMM's paper and its published code decode in different ways."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

EditingNoise = Literal["gumbel", "none", "as_printed"]
LastEdit = Literal["all_layers", "base"]
FinalTokens = Literal["mixture", "sampled"]
ResidualTokens = Literal["likeliest", "sampled"]


@dataclass(frozen=True)
class DecodingRules:
    """The defaults are the published code's, but for ``last_edit`` and ``pad_class``."""

    editing_noise: EditingNoise = (
        "gumbel"  # in logits editing; paper, formula 7: none; 10 as it is: as_printed
    )
    last_edit: LastEdit = (
        "all_layers"  # logits editing of the last step sees the residual layers; published: "base" alone
    )
    noise_twice: bool = True  # tokens on the way are drawn from weights that hold noise already; False: once
    text_top_share: float = 0.1  # of the codes can be drawn when decoding from text ("top-k 0.9")
    top_share: float = 1.0  # the same under control; the paper says as MoMask, which is 0.1
    final_tokens: FinalTokens = "mixture"  # base layer at the end: mean code, or a code drawn (the paper)
    residual_tokens: ResidualTokens = "likeliest"  # or drawn from the top tenth, as MoMask does
    pad_class: bool = (
        False  # True as published: "no code" can win in residual layers, and over base logits < 0
    )

    def __post_init__(self) -> None:
        for name, kind in (
            ("editing_noise", EditingNoise),
            ("last_edit", LastEdit),
            ("final_tokens", FinalTokens),
            ("residual_tokens", ResidualTokens),
        ):
            if getattr(self, name) not in get_args(kind):
                raise ValueError(f"`{name}` must be one of {get_args(kind)}, got {getattr(self, name)!r}.")
        for name in ("text_top_share", "top_share"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"`{name}` must be above 0 and at most 1, got {getattr(self, name)}.")


def likeliest_share(logits: Float[Tensor, "B L K"], share: float) -> Float[Tensor, "B L K"]:
    """Logits of the likeliest ``share`` of the codes, -inf elsewhere."""
    if share == 1:
        return logits
    kept = logits.topk(math.ceil(share * logits.shape[-1]), dim=-1).indices
    return torch.full_like(logits, -math.inf).scatter(-1, kept, logits.gather(-1, kept))
