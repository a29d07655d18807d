"""Residual transformer: codes of the layers so far -> codes of the next layer (MoMask, CVPR 2024)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import one_hot, pad

from controlmm.models.masked_transformer import with_text_token
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
class ResidualTransformerConfig:
    """Transformer that fills in the residual layers one by one."""

    codebook_size: int = 512
    num_quantizers: int = 6  # layers of the tokenizer, the base layer included
    token_dim: int = 512
    width: int = 384
    heads: int = 6
    layers: int = 8
    feedforward: int = 1024
    dropout: float = 0.2
    text_dim: int = 512
    text_scale: float = 1.0
    text_dropout: float = 0.2
    max_tokens: int = 98
    shares_tables: bool = (
        True  # inner layers score with the table that embeds them, as in all published weights
    )

    def __post_init__(self) -> None:
        if self.width % self.heads:
            raise ValueError(f"`width` must be a multiple of `heads`, got {self.width} and {self.heads}.")
        least = 3 if self.shares_tables else 2
        if self.num_quantizers < least:
            raise ValueError(
                f"`num_quantizers` must be at least {least}{' to share tables' * self.shares_tables}, "
                f"got {self.num_quantizers}."
            )

    @classmethod
    def paper(cls) -> ResidualTransformerConfig:
        """The published size: 13.4 M parameters, CLIP text."""
        return cls()

    @classmethod
    def small(cls) -> ResidualTransformerConfig:
        """The size that ships: 3.0 M parameters, MiniLM text."""
        return cls(
            token_dim=192,
            width=256,
            heads=4,
            layers=4,
            feedforward=512,
            dropout=0.1,
            text_dim=384,
            text_scale=20.0,
        )

    @classmethod
    def tiny(cls) -> ResidualTransformerConfig:
        """For tests."""
        return cls(
            codebook_size=32, num_quantizers=3, token_dim=16, width=16, heads=2, layers=2, feedforward=32,
            dropout=0.0, text_dim=64,
        )  # fmt: skip

    def for_text(self, text_dim: int) -> ResidualTransformerConfig:
        """The same sizes for another text encoder."""
        return replace(self, text_dim=text_dim)


class ResidualTransformer(PretrainedModel):
    """Sequence: text token, layer token, ``L`` motion tokens (sums of code embeddings of the earlier layers).

    The middle layers' tables serve as input and as output tables; the first input and last output table are
    their own. Without sharing all tables are their own, and the scores have a bias. Every table has one row
    more than there are codes, for PAD.
    """

    config_class: ClassVar[type] = ResidualTransformerConfig
    config: ResidualTransformerConfig
    positions: Tensor

    def __init__(self, config: ResidualTransformerConfig) -> None:
        super().__init__(config)
        rows, layers = config.codebook_size + 1, config.num_quantizers - 1
        if config.shares_tables:
            self.first_table = _fresh_tables(1, rows, config.token_dim)
            self.shared_tables = _fresh_tables(layers - 1, rows, config.token_dim)
            self.last_table = _fresh_tables(1, rows, config.token_dim)
        else:
            self.own_input_tables = _fresh_tables(layers, rows, config.token_dim)
            self.own_output_tables = _fresh_tables(layers, rows, config.token_dim)
            self.output_bias = nn.Parameter(torch.zeros(layers, rows))
        self.token_proj = nn.Linear(config.token_dim, config.width)
        self.text_proj = nn.Linear(config.text_dim, config.width)
        self.layer_proj = nn.Linear(config.num_quantizers, config.width)
        self.dropout = Dropout(config.dropout)
        self.layers = encoder_layers(
            config.layers,
            width=config.width,
            heads=config.heads,
            feedforward=config.feedforward,
            dropout=config.dropout,
        )
        self.head = output_head(config.width, config.token_dim)
        self.register_buffer(
            "positions", sinusoidal_positions(config.max_tokens, config.width), persistent=False
        )
        self.apply(initialize_weights)

    @property
    def pad_id(self) -> int:
        """Row of positions after the end of a clip."""
        return self.config.codebook_size

    def input_tables(self) -> Float[Tensor, "Q1 R E"]:
        """Tables that embed the codes of layers 0..Q-2."""
        if not self.config.shares_tables:
            return self.own_input_tables
        return torch.cat([self.first_table, self.shared_tables])

    def output_tables(self) -> Float[Tensor, "Q1 R E"]:
        """Tables that score the codes of layers 1..Q-1."""
        if not self.config.shares_tables:
            return self.own_output_tables
        return torch.cat([self.shared_tables, self.last_table])

    def history(self, ids: Int[Tensor, "B L Q"], layer: Int[Tensor, "B"]) -> Float[Tensor, "B L E"]:
        """Sum of the embeddings of the true codes of layers ``0..layer-1``; -1 counts as PAD."""
        tables = self.input_tables()
        ids = torch.where(ids < 0, self.pad_id, ids)
        embedded = torch.stack(
            [table[ids[..., i]] for i, table in enumerate(tables)], dim=1
        )  # (B, Q-1, L, E)
        earlier = torch.arange(len(tables), device=layer.device) < layer[:, None]
        return (embedded * earlier[:, :, None, None]).sum(1)

    def forward(
        self,
        history: Float[Tensor, "B L E"],
        layer: Int[Tensor, "B"],
        text: Float[Tensor, "B D"],
        valid: Bool[Tensor, "B L"],
        hints: Sequence[Float[Tensor, "B L W"]] | None = None,
    ) -> Float[Tensor, "B L R"]:
        """Logits of layer ``layer`` (1..Q-1), codes and PAD.

        ``hints`` of a :class:`ResidualControl` are added to the motion tokens: the first to the input, the
        others to what each transformer layer puts out.
        """
        tokens = self.dropout(self.token_proj(history) + self.positions[: history.shape[1]])
        text_token = self.text_proj(text * self.config.text_scale)[:, None]
        layer_token = self.layer_proj(one_hot(layer, self.config.num_quantizers).to(tokens.dtype))[:, None]
        if hints is not None:
            tokens = tokens + hints[0]
            hints = [pad(hint, (0, 0, 2, 0)) for hint in hints[1:]]  # nothing for text and layer
        sequence = torch.cat([text_token, layer_token, tokens], dim=1)
        hidden = run_layers(self.layers, sequence, with_text_token(valid, 2), hints)
        predicted: Tensor = self.head(hidden[:, 2:])
        logits = self._scores(predicted, layer)
        return logits if self.config.shares_tables else logits + self.output_bias[layer - 1][:, None]

    def _scores(self, predicted: Float[Tensor, "B L E"], layer: Int[Tensor, "B"]) -> Float[Tensor, "B L R"]:
        """Products with the rows of each clip's table."""
        tables = self.output_tables()
        if (layer == layer[0]).all():  # as in generation: no copy of the table for every clip
            return row_product(predicted, tables[layer[0] - 1].T)
        return torch.einsum("ble,bre->blr", predicted, tables[layer - 1])


def _fresh_tables(count: int, rows: int, dim: int) -> nn.Parameter:
    return nn.Parameter(torch.randn(count, rows, dim) * 0.02)
