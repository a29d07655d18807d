"""What masked decoding is asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.generation.clip_groups import clips_of_like_length
from controlmm.generation.decoding_rules import DecodingRules
from controlmm.generation.kept_tokens import KeptTokens
from controlmm.generation.noise import ClipNoise
from controlmm.generation.solvers import Progress


@dataclass(frozen=True)
class DecodingRequest:
    """A batch of clips to decode, padded to the longest.

    ``dtype`` is that of the decoder that tells the networks where joints are; networks have their own.
    """

    text: Float[Tensor, "B E"]
    valid: Bool[Tensor, "B L"]
    noise: ClipNoise
    steps: int = 10
    guidance_scale: float = 4.0
    guided_share: float = 1.0  # of the steps, the first ones
    rules: DecodingRules = field(default_factory=DecodingRules)
    progress: Progress | None = None
    watch: Callable[[int, Float[Tensor, "B L"]], None] | None = None  # (step, confidence of every token)
    kept: KeptTokens | None = None  # of a motion that is there; the others are drawn
    dtype: torch.dtype = torch.float32

    def guidance_in(self, step: int) -> float:
        """Scale of guidance in a step, counted from 0."""
        return self.guidance_scale if step < self.guided_share * self.steps else 1.0

    @property
    def lengths(self) -> list[int]:
        """Tokens of each clip."""
        counts: list[int] = self.valid.sum(1).tolist()
        return counts

    @cached_property
    def groups(self) -> list[Int[Tensor, "N"]]:
        """Clips that networks take together."""
        return clips_of_like_length(self.lengths)

    @property
    def drawn(self) -> Bool[Tensor, "B L"]:
        """Which tokens are drawn."""
        return self.valid if self.kept is None else self.valid & ~self.kept.where

    def gumbel(self, width: int) -> Float[Tensor, "B L K"]:
        """Fresh noise for every token of every clip."""
        return self.noise.gumbel(self.lengths, padded=self.valid.shape[1], width=width)

    def report(self, step: int, confidence: Float[Tensor, "B L"]) -> None:
        """Tell the caller that ``step`` steps are done, and how sure the model was of what it drew."""
        if self.progress is not None:
            self.progress("masked decoding", step, self.steps)
        if self.watch is not None:
            self.watch(step, confidence)
