"""Copies of networks for generation: weights frozen, packed once, and multiplied in bfloat16 where that pays.

A copy is of the class of its network and takes the same arguments; only its linear layers, convolutions and
transformer layers are others. These leave padding out. What a copy makes of a clip depends neither on padding
nor on the clips beside it nor on the number of threads, to the bit.
"""

from __future__ import annotations

import copy
import threading
from collections.abc import Sequence
from itertools import groupby
from typing import TypeVar, cast
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import layer_norm, pad, scaled_dot_product_attention

from controlmm.generation.frozen_matrix import Activation, FrozenMatrix

_HEAD = "head"  # makes the logits, whose differences count: float32 always
_Network = TypeVar("_Network", bound=nn.Module)
_Version = tuple[int, ...]  # of the weights: where they are and how often they were written
_PACKING = threading.Lock()  # shares of a batch ask for the same copy at once: one packs it, the others wait


def packed_copy(network: _Network, dtype: torch.dtype) -> _Network:
    """A copy of ``network`` with packed weights; later changes of ``network`` are not seen.

    Args:
        network: In evaluation mode, on the CPU.
        dtype: Of the products with weights, but for those of the head. Attention, normalisation and what goes
            from layer to layer are float32 in any case.
    """
    packed = copy.deepcopy(network)
    _pack_children(packed, dtype)
    return packed


class PackedCopies:
    """Packed copies of networks, made at their first use, and anew when weights have changed since."""

    def __init__(self) -> None:
        self._known: WeakKeyDictionary[nn.Module, dict[torch.dtype, tuple[_Version, nn.Module]]] = (
            WeakKeyDictionary()
        )

    def of(self, network: _Network, dtype: torch.dtype) -> _Network:
        """The copy of ``network`` that multiplies in ``dtype``."""
        version = tuple(x for weight in network.parameters() for x in (weight.data_ptr(), weight._version))
        with _PACKING:
            copies = self._known.setdefault(network, {})
            if dtype not in copies or copies[dtype][0] != version:
                copies[dtype] = version, packed_copy(network, dtype)
            return cast(_Network, copies[dtype][1])


def _pack_children(module: nn.Module, dtype: torch.dtype) -> None:
    for name, child in module.named_children():
        own = torch.float32 if name == _HEAD else dtype
        if isinstance(child, nn.Linear):
            setattr(module, name, PackedLinear(child, own))
        elif isinstance(child, nn.Conv1d):
            setattr(module, name, PackedConv(child, own))
        elif isinstance(child, nn.TransformerEncoderLayer):
            setattr(module, name, PackedEncoderLayer(child, own))
        else:
            _pack_children(child, own)


class _Product:
    """A frozen matrix between float32 tensors of any shape."""

    def __init__(self, weight: Tensor, bias: Tensor | None, dtype: torch.dtype) -> None:
        self._matrix, self._dtype = FrozenMatrix(weight, bias, dtype), dtype

    def __call__(self, x: Float[Tensor, "*N in"], activation: Activation = "none") -> Float[Tensor, "*N out"]:
        return self.raw(x, activation).float()

    def raw(self, x: Tensor, activation: Activation = "none") -> Tensor:
        """The result as the product leaves it, for another product or a sum with float32."""
        rows = self._matrix(x.flatten(0, -2).to(self._dtype), activation=activation)
        return rows.unflatten(0, x.shape[:-1]) if x.ndim > 2 else rows


class PackedLinear(nn.Module):
    """A frozen ``nn.Linear``."""

    def __init__(self, linear: nn.Linear, dtype: torch.dtype) -> None:
        super().__init__()
        self._product = _Product(linear.weight, linear.bias, dtype)

    def forward(self, x: Float[Tensor, "*N in"]) -> Float[Tensor, "*N out"]:
        """The product."""
        return self._product(x)


class PackedConv(nn.Module):
    """A frozen ``nn.Conv1d`` without groups, zeros beyond the ends."""

    def __init__(self, conv: nn.Conv1d, dtype: torch.dtype) -> None:
        super().__init__()
        (self._taps,), (self._dilation,), self.stride = conv.kernel_size, conv.dilation, conv.stride
        assert not isinstance(conv.padding, str)  # neither words nor groups in any network of ours
        assert conv.groups == 1
        (self._padding,) = conv.padding
        self._product = _Product(conv.weight.permute(0, 2, 1).flatten(1), conv.bias, dtype)

    def forward(self, x: Float[Tensor, "B C T"]) -> Float[Tensor, "B D S"]:
        """The convolution."""
        rows = x.transpose(1, 2)
        if self._padding:
            rows = pad(rows, (0, 0, self._padding, self._padding))
        (stride,), reach = self.stride, (self._taps - 1) * self._dilation
        last = rows.shape[1] - reach
        taps = [rows[:, at : at + last : stride] for at in range(0, reach + 1, self._dilation)]
        product = self._product(taps[0] if len(taps) == 1 else torch.cat(taps, dim=-1))
        return product.transpose(1, 2)


class PackedEncoderLayer(nn.Module):
    """A frozen post-norm ``nn.TransformerEncoderLayer`` that makes nothing of padding: zeros.

    Attention stays in float32: in bfloat16 a clip's numbers would depend on its batch.
    """

    def __init__(self, layer: nn.TransformerEncoderLayer, dtype: torch.dtype) -> None:
        super().__init__()
        attention = layer.self_attn
        assert not layer.norm_first  # as `encoder_layers` makes them
        self._heads = attention.num_heads
        self._inputs = _Product(attention.in_proj_weight, attention.in_proj_bias, dtype)
        self._outputs = _Product(attention.out_proj.weight, attention.out_proj.bias, dtype)
        self._wide = _Product(layer.linear1.weight, layer.linear1.bias, dtype)
        self._narrow = _Product(layer.linear2.weight, layer.linear2.bias, dtype)
        self._activation: Activation = "relu" if layer.activation_relu_or_gelu == 1 else "gelu"
        self.norm1, self.norm2 = layer.norm1, layer.norm2

    def forward(
        self, hidden: Float[Tensor, "B S W"], src_key_padding_mask: Bool[Tensor, "B S"]
    ) -> Float[Tensor, "B S W"]:
        """As the layer that it is a copy of."""
        rows, valid = hidden.flatten(0, 1), ~src_key_padding_mask
        lengths: list[int] = valid.sum(1).tolist()
        if not valid.all():
            rows = rows[valid.flatten()]
        attended = self._attended(self._inputs(rows), lengths)
        rows = _normalised(self.norm1, rows + self._outputs.raw(attended))
        inner = self._wide.raw(rows, self._activation)
        rows = _normalised(self.norm2, rows + self._narrow.raw(inner))
        if len(rows) == valid.numel():
            return rows.view(hidden.shape)
        result = torch.zeros_like(hidden)
        result[valid] = rows
        return result

    def _attended(self, rows: Float[Tensor, "N 3W"], lengths: Sequence[int]) -> Float[Tensor, "N W"]:
        """Each clip attends to itself; ``rows`` are those of all clips without their padding."""
        attended = rows.new_empty(len(rows), rows.shape[1] // 3)
        first = 0
        for length, alike in groupby(lengths):
            last = first + length * len(list(alike))
            attended[first:last] = self._attended_alike(rows[first:last], length)
            first = last
        return attended

    def _attended_alike(self, rows: Float[Tensor, "N 3W"], length: int) -> Float[Tensor, "N W"]:
        """Of clips of one length."""
        parts = rows.view(-1, length, 3, self._heads, rows.shape[1] // (3 * self._heads))
        queries, keys, values = parts.permute(2, 0, 3, 1, 4)
        attended = scaled_dot_product_attention(queries, keys, values)
        return attended.transpose(1, 2).reshape(len(rows), -1)


def _normalised(norm: nn.LayerNorm, rows: Float[Tensor, "N W"]) -> Float[Tensor, "N W"]:
    return layer_norm(rows, norm.normalized_shape, norm.weight, norm.bias, norm.eps)
