"""The transformer trunk that the masked, residual and control networks share."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from controlmm.nn.dropout import Dropout

_WEIGHT_STD = 0.02


def encoder_layers(
    count: int, *, width: int, heads: int, feedforward: int, dropout: float, activation: str = "gelu"
) -> nn.ModuleList:
    """``count`` standard post-norm encoder layers with exact GELU (or ``activation="relu"``)."""
    layers = nn.ModuleList(
        nn.TransformerEncoderLayer(
            width, heads, feedforward, dropout, activation=activation, layer_norm_eps=1e-5, batch_first=True
        )
        for _ in range(count)
    )
    for layer in layers:
        layer.dropout, layer.dropout1, layer.dropout2 = (Dropout(dropout) for _ in range(3))
    return layers


def run_layers(
    layers: nn.ModuleList,
    hidden: Float[Tensor, "B S W"],
    valid: Bool[Tensor, "B S"],
    residuals: Sequence[Float[Tensor, "B S W"]] | None = None,
) -> Float[Tensor, "B S W"]:
    """All layers in turn; positions that are not ``valid`` are attended by nobody.

    ``residuals[i]`` is added to the output of layer ``i``: that is how the control branch speaks to the
    frozen trunk.
    """
    padding = ~valid
    for index, layer in enumerate(layers):
        hidden = layer(hidden, src_key_padding_mask=padding)
        if residuals is not None:
            hidden = hidden + residuals[index]
    return hidden


def sinusoidal_positions(count: int, width: int) -> Float[Tensor, "L W"]:
    """Sine at even, cosine at odd channels, frequency ``exp(-2 i ln(10000) / W)`` (Vaswani et al., 2017)."""
    positions = torch.arange(count, dtype=torch.float32)[:, None]
    frequencies = torch.exp(torch.arange(0, width, 2, dtype=torch.float32) * (-math.log(10000.0) / width))
    angles = positions * frequencies
    return torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1)[:, :width]


def output_head(width: int, out_dim: int) -> nn.Sequential:
    """Linear, GELU, LayerNorm, linear."""
    return nn.Sequential(
        nn.Linear(width, width), nn.GELU(), nn.LayerNorm(width, eps=1e-12), nn.Linear(width, out_dim)
    )


def zero_linear(in_dim: int, out_dim: int) -> nn.Linear:
    """A linear layer that puts out zeros until it is trained (ControlNet)."""
    linear = nn.Linear(in_dim, out_dim)
    nn.init.zeros_(linear.weight)
    nn.init.zeros_(linear.bias)
    return linear


def initialize_weights(module: nn.Module) -> None:
    """Normal(0, 0.02) linear and embedding weights, zero biases; attention keeps its Xavier in-projection."""
    if isinstance(module, nn.Linear | nn.Embedding):
        module.weight.data.normal_(0.0, _WEIGHT_STD)
    if isinstance(module, nn.Linear) and module.bias is not None:
        module.bias.data.zero_()


def drop_text(text: Float[Tensor, "B E"], probability: float) -> Float[Tensor, "B E"]:
    """Text vectors, each with ``probability`` set to zero, the vector that stands for "no text"."""
    return text * (torch.rand(len(text), 1, device=text.device) >= probability)
