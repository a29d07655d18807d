"""Length estimator: a text's likely lengths, as a distribution over token counts (MoMask, CVPR 2024)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor, nn

from controlmm.nn.checkpoint import PretrainedModel
from controlmm.nn.trunk import initialize_weights


@dataclass(frozen=True)
class LengthEstimatorConfig:
    """Multilayer perceptron from a text vector to the number of tokens."""

    text_dim: int = 512
    classes: int = 50  # class c stands for c tokens, so the longest motion has ``classes - 1``
    width: int = 512  # of the first hidden layer; the others have a half and a quarter of it
    dropout: float = 0.2
    text_scale: float = 1.0  # multiplies the text vector; unit-length vectors want about sqrt(text_dim)

    def __post_init__(self) -> None:
        if self.width % 4 or self.width < 4 or self.classes < 2:
            raise ValueError(f"`width` must be a multiple of 4 and `classes` at least 2, got {self}.")

    @classmethod
    def paper(cls) -> LengthEstimatorConfig:
        """The published size: 0.44 M parameters, CLIP text."""
        return cls()

    @classmethod
    def small(cls) -> LengthEstimatorConfig:
        """The size for the model that ships: MiniLM text."""
        return cls(text_dim=384, width=256, text_scale=20.0)

    @classmethod
    def tiny(cls) -> LengthEstimatorConfig:
        """For tests."""
        return cls(text_dim=64, width=16)

    def for_text(self, text_dim: int) -> LengthEstimatorConfig:
        """The same sizes for another text encoder."""
        return replace(self, text_dim=text_dim)


class LengthEstimator(PretrainedModel):
    """Text vector (B, E) -> logits of the token count (B, N), to draw a length from their softmax."""

    config_class: ClassVar[type] = LengthEstimatorConfig
    config: LengthEstimatorConfig

    def __init__(self, config: LengthEstimatorConfig) -> None:
        super().__init__(config)
        first, second, third = config.width, config.width // 2, config.width // 4
        self.layers = nn.Sequential(
            *_hidden(config.text_dim, first, config.dropout),
            *_hidden(first, second, config.dropout),
            *_hidden(second, third)[:3],
            nn.Linear(third, config.classes),
        )
        self.apply(initialize_weights)

    def forward(self, text: Float[Tensor, "B E"]) -> Float[Tensor, "B N"]:
        """Logits of 0, 1, 2, ... tokens."""
        logits: Tensor = self.layers(text * self.config.text_scale)
        return logits


def _hidden(in_dim: int, out_dim: int, dropout: float = 0.0) -> tuple[nn.Module, ...]:
    return nn.Linear(in_dim, out_dim), nn.LayerNorm(out_dim), nn.LeakyReLU(0.2), nn.Dropout(dropout)
