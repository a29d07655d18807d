"""Masked transformer: text and partly masked base tokens -> logits of all base tokens (MoMask, CVPR 2024)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from controlmm.nn.checkpoint import PretrainedModel
from controlmm.nn.dropout import Dropout
from controlmm.nn.row_product import row_product
from controlmm.nn.trunk import (
    encoder_layers,
    initialize_weights,
    output_head,
    run_layers,
    sinusoidal_positions,
)


@dataclass(frozen=True)
class MaskedTransformerConfig:
    """Bidirectional transformer over base-layer tokens."""

    codebook_size: int = 512  # K, without the MASK and PAD tokens
    token_dim: int = 512  # width of the embedding table
    width: int = 384
    heads: int = 6
    layers: int = 8
    feedforward: int = 1024
    dropout: float = 0.2
    text_dim: int = 512  # width of the text encoder's pooled vector
    text_scale: float = 1.0  # multiplies the text vector; unit-length vectors want about sqrt(text_dim)
    text_dropout: float = 0.1  # share of training samples that see no text
    max_tokens: int = 98  # longest sequence

    def __post_init__(self) -> None:
        if self.width % self.heads:
            raise ValueError(f"`width` must be a multiple of `heads`, got {self.width} and {self.heads}.")

    @classmethod
    def paper(cls) -> MaskedTransformerConfig:
        """The published size: 12.1 M parameters, CLIP text."""
        return cls()

    @classmethod
    def small(cls) -> MaskedTransformerConfig:
        """The size that ships: 3.7 M parameters, MiniLM text."""
        return cls(
            token_dim=192,
            width=256,
            heads=4,
            layers=6,
            feedforward=512,
            dropout=0.1,
            text_dim=384,
            text_scale=20.0,
        )

    @classmethod
    def tiny(cls) -> MaskedTransformerConfig:
        """For tests."""
        return cls(
            codebook_size=32,
            token_dim=16,
            width=16,
            heads=2,
            layers=2,
            feedforward=32,
            dropout=0.0,
            text_dim=64,
        )

    def for_text(self, text_dim: int) -> MaskedTransformerConfig:
        """The same sizes for another text encoder."""
        return replace(self, text_dim=text_dim)


class MaskedTransformer(PretrainedModel):
    """Predicts all base tokens at once. Sequence: one text token, then ``L`` motion tokens."""

    config_class: ClassVar[type] = MaskedTransformerConfig
    config: MaskedTransformerConfig
    positions: Tensor

    def __init__(self, config: MaskedTransformerConfig) -> None:
        super().__init__(config)
        self.token_embedding = nn.Embedding(config.codebook_size + 2, config.token_dim)
        self.token_proj = nn.Linear(config.token_dim, config.width)
        self.text_proj = nn.Linear(config.text_dim, config.width)
        self.dropout = Dropout(config.dropout)
        self.layers = encoder_layers(
            config.layers,
            width=config.width,
            heads=config.heads,
            feedforward=config.feedforward,
            dropout=config.dropout,
        )
        self.head = output_head(config.width, config.codebook_size)
        self.register_buffer(
            "positions", sinusoidal_positions(config.max_tokens, config.width), persistent=False
        )
        self.apply(initialize_weights)

    @property
    def mask_id(self) -> int:
        """Token id that stands for "unknown"."""
        return self.config.codebook_size

    @property
    def pad_id(self) -> int:
        """Token id of positions after the end of a clip."""
        return self.config.codebook_size + 1

    def embed(self, ids: Int[Tensor, "B L"]) -> Float[Tensor, "B L E"]:
        """Embeddings of hard tokens, MASK and PAD included."""
        embedded: Tensor = self.token_embedding(ids)
        return embedded

    def embed_soft(self, probabilities: Float[Tensor, "B L K"]) -> Float[Tensor, "B L E"]:
        """Embeddings of soft (differentiable) tokens."""
        return row_product(probabilities, self.token_embedding.weight[: self.config.codebook_size])

    def sequence(
        self, embedded: Float[Tensor, "B L E"], text: Float[Tensor, "B D"]
    ) -> Float[Tensor, "B S W"]:
        """The trunk's input: the text token, then the tokens with position codes.

        Raises:
            ValueError: If there are more tokens than ``max_tokens``.
        """
        if embedded.shape[1] > self.config.max_tokens:
            raise ValueError(
                f"At most {self.config.max_tokens} tokens are possible, got {embedded.shape[1]}."
            )
        tokens = self.dropout(self.token_proj(embedded) + self.positions[: embedded.shape[1]])
        text_token = self.text_proj(text * self.config.text_scale)[:, None]
        return torch.cat([text_token, tokens], dim=1)

    def forward(
        self,
        embedded: Float[Tensor, "B L E"],
        text: Float[Tensor, "B D"],
        valid: Bool[Tensor, "B L"],
    ) -> Float[Tensor, "B L K"]:
        """Logits of the base codes without control; see :meth:`logits` for the parts."""
        return self.logits(self.sequence(embedded, text), valid)

    def logits(
        self,
        sequence: Float[Tensor, "B S W"],
        valid: Bool[Tensor, "B L"],
        residuals: Sequence[Float[Tensor, "B S W"]] | None = None,
    ) -> Float[Tensor, "B L K"]:
        """Trunk and head over a :meth:`sequence`; ``residuals`` come from the control branch, one a layer."""
        hidden = run_layers(self.layers, sequence, with_text_token(valid), residuals)
        predicted: Tensor = self.head(hidden[:, 1:])
        return predicted


def with_text_token(valid: Bool[Tensor, "B L"], count: int = 1) -> Bool[Tensor, "B S"]:
    """``valid`` with ``count`` always-valid positions in front."""
    return torch.cat([valid.new_ones(len(valid), count), valid], dim=1)
