"""The BERT encoder (Devlin et al., NAACL 2019), forward only, loaded from published checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

_EMBEDDING_NAMES = {
    "embeddings.word_embeddings": "words",
    "embeddings.position_embeddings": "positions",
    "embeddings.token_type_embeddings": "token_types",
    "embeddings.LayerNorm": "norm",
}
_LAYER_NAMES = {
    "attention.self.query": "query",
    "attention.self.key": "key",
    "attention.self.value": "value",
    "attention.output.dense": "attention_out",
    "attention.output.LayerNorm": "attention_norm",
    "intermediate.dense": "expand",
    "output.dense": "contract",
    "output.LayerNorm": "output_norm",
}


@dataclass(frozen=True)
class BertConfig:
    """Sizes of a BERT encoder, named as in the ``config.json`` of published checkpoints."""

    vocab_size: int = 30522
    hidden_size: int = 384  # width C
    num_hidden_layers: int = 6
    num_attention_heads: int = 12
    intermediate_size: int = 1536  # width inside the feed-forward blocks
    max_position_embeddings: int = 512  # longest input in tokens
    type_vocab_size: int = 2
    layer_norm_eps: float = 1e-12

    def __post_init__(self) -> None:
        if self.hidden_size % self.num_attention_heads:
            raise ValueError(
                f"`hidden_size` must be a multiple of `num_attention_heads`, "
                f"got {self.hidden_size} and {self.num_attention_heads}."
            )

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> BertConfig:
        """The sizes in a checkpoint's ``config.json``; its other keys do not matter here.

        Raises:
            ValueError: If it describes another kind of network.
        """
        kind = (values.get("model_type"), values.get("hidden_act"))
        if kind != ("bert", "gelu"):
            raise ValueError(f"Expected a network of type bert with gelu, got {kind[0]} with {kind[1]}.")
        return cls(**{name: values[name] for name in cls.__dataclass_fields__ if name in values})


class BertLayer(nn.Module):
    """Self-attention and feed-forward block, each followed by a residual sum and a layer norm."""

    def __init__(self, config: BertConfig) -> None:
        super().__init__()
        width = config.hidden_size
        self.heads = config.num_attention_heads
        self.query, self.key, self.value = (nn.Linear(width, width) for _ in range(3))
        self.attention_out = nn.Linear(width, width)
        self.attention_norm = nn.LayerNorm(width, eps=config.layer_norm_eps)
        self.expand = nn.Linear(width, config.intermediate_size)
        self.contract = nn.Linear(config.intermediate_size, width)
        self.output_norm = nn.LayerNorm(width, eps=config.layer_norm_eps)

    def forward(self, x: Float[Tensor, "B S C"], mask: Bool[Tensor, "B S"]) -> Float[Tensor, "B S C"]:
        """The next hidden states; tokens where ``mask`` is false are not attended to."""
        projections = (self.query(x), self.key(x), self.value(x))
        # (B, S, C) -> (B, heads, S, C / heads)
        q, k, v = (p.unflatten(-1, (self.heads, -1)).transpose(1, 2) for p in projections)
        attended = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask[:, None, None, :])
        x = self.attention_norm(x + self.attention_out(attended.transpose(1, 2).flatten(2)))
        hidden: Tensor = self.output_norm(x + self.contract(functional.gelu(self.expand(x))))
        return hidden


class Bert(nn.Module):
    """Embeddings and layers of BERT, without the pooler that sentence encoders do not use."""

    def __init__(self, config: BertConfig) -> None:
        super().__init__()
        self.config = config
        self.words = nn.Embedding(config.vocab_size, config.hidden_size)
        self.positions = nn.Embedding(config.max_position_embeddings, config.hidden_size)
        self.token_types = nn.Embedding(config.type_vocab_size, config.hidden_size)
        self.norm = nn.LayerNorm(config.hidden_size, eps=config.layer_norm_eps)
        self.layers = nn.ModuleList(BertLayer(config) for _ in range(config.num_hidden_layers))

    def forward(self, ids: Int[Tensor, "B S"], mask: Bool[Tensor, "B S"]) -> Float[Tensor, "B S C"]:
        """Last hidden states of single sentences (token type 0); meaningless where ``mask`` is false."""
        x = self.norm(self.words(ids) + self.positions.weight[: ids.shape[1]] + self.token_types.weight[0])
        for layer in self.layers:
            x = layer(x, mask)
        return x  # type: ignore[no-any-return]

    @classmethod
    def from_checkpoint(cls, config: BertConfig, weights: Mapping[str, Tensor]) -> Bert:
        """A frozen network with published weights; draws no random numbers.

        Raises:
            ValueError: If weights are missing or have another shape than ``config`` says.
        """
        with torch.device("meta"):
            network = cls(config)
        renamed = {new: weights[old].float() for old, new in _renaming(config).items() if old in weights}
        missing = sorted(set(network.state_dict()) - set(renamed))
        if missing:
            raise ValueError(f"{len(missing)} weights are missing, the first is {missing[0]!r}.")
        try:
            network.load_state_dict(renamed, assign=True)
        except RuntimeError as error:
            raise ValueError(" ".join(str(error).split())) from error
        return network.eval().requires_grad_(False)


def _renaming(config: BertConfig) -> dict[str, str]:
    """Published name of every weight -> our name."""
    modules = dict(_EMBEDDING_NAMES)
    for index in range(config.num_hidden_layers):
        old_layer, new_layer = f"encoder.layer.{index}", f"layers.{index}"
        modules |= {f"{old_layer}.{old}": f"{new_layer}.{new}" for old, new in _LAYER_NAMES.items()}
    return {f"{old}.{kind}": f"{new}.{kind}" for old, new in modules.items() for kind in ("weight", "bias")}
