"""The BERT encoder: masking, and what it refuses to load. test_text_minilm.py checks values."""

from __future__ import annotations

import pytest
import torch

from controlmm.text.bert import Bert, BertConfig

TINY = BertConfig(
    vocab_size=11, hidden_size=8, num_hidden_layers=1, num_attention_heads=2, intermediate_size=16,
    max_position_embeddings=5,
)  # fmt: skip


def published_names(config: BertConfig) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    width, wide = config.hidden_size, config.intermediate_size
    shapes = {
        "embeddings.word_embeddings.weight": (config.vocab_size, width),
        "embeddings.position_embeddings.weight": (config.max_position_embeddings, width),
        "embeddings.token_type_embeddings.weight": (2, width),
    }
    linears = {"attention.self.query": (width, width), "attention.self.key": (width, width),
               "attention.self.value": (width, width), "attention.output.dense": (width, width),
               "intermediate.dense": (wide, width), "output.dense": (width, wide)}  # fmt: skip
    for name, shape in linears.items():
        shapes |= {f"encoder.layer.0.{name}.weight": shape, f"encoder.layer.0.{name}.bias": shape[:1]}
    norms = ("embeddings", "encoder.layer.0.attention.output", "encoder.layer.0.output")
    for name in norms:
        shapes |= {f"{name}.LayerNorm.weight": (width,), f"{name}.LayerNorm.bias": (width,)}
    return {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}


def test_masked_tokens_do_not_change_the_others():
    network = Bert.from_checkpoint(TINY, published_names(TINY))
    mask = torch.tensor([[True, True, True, False, False]])
    one = network(torch.tensor([[1, 2, 3, 0, 0]]), mask)
    other = network(torch.tensor([[1, 2, 3, 9, 7]]), mask)
    torch.testing.assert_close(one[:, :3], other[:, :3])
    assert not torch.allclose(one[:, 3:], other[:, 3:])


def test_missing_weights_are_counted_and_named():
    weights = published_names(TINY)
    del weights["encoder.layer.0.output.dense.bias"]
    with pytest.raises(ValueError, match=r"1 weights are missing, the first is 'layers.0.contract.bias'"):
        Bert.from_checkpoint(TINY, weights)


def test_weights_of_another_size_are_refused():
    weights = published_names(TINY) | {"embeddings.LayerNorm.bias": torch.zeros(9)}
    with pytest.raises(ValueError, match=r"size mismatch for norm.bias"):
        Bert.from_checkpoint(TINY, weights)


def test_width_must_divide_into_heads():
    with pytest.raises(ValueError, match="must be a multiple of `num_attention_heads`, got 8 and 3"):
        BertConfig(hidden_size=8, num_attention_heads=3)
