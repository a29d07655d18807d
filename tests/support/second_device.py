"""A second device without one: tensors that say they are elsewhere and refuse to meet those of the CPU.

Code that makes a tensor on the CPU in the middle of work on a GPU fails there only. Here every operator runs
on the CPU, but one whose arguments are partly "elsewhere" and partly not raises, as CUDA does. The label is
``meta``, the one device besides the CPU that every build of torch knows.
"""

from __future__ import annotations

from contextlib import contextmanager

import torch
from torch import nn
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

ELSEWHERE = torch.device("meta")
_COPIES = ("aten._to_copy", "aten.copy_")
_TAKE_CPU_INDICES = ("aten.index.Tensor", "aten.index_put", "aten._index_put_impl_", "aten._unsafe_index")
_PACKING = "aten._pack_padded_sequence.default"  # lengths must come from the CPU, and batch sizes stay there


class _Away(torch.Tensor):
    """A CPU tensor that says it is elsewhere."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner):
        return torch.Tensor._make_wrapper_subclass(
            cls,
            inner.shape,
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=ELSEWHERE,
        )

    def __init__(self, inner):
        self.inner = inner

    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        if func in (torch.Tensor.__getitem__, torch.Tensor.__setitem__):
            args = (args[0], _with_tensors(args[1]), *args[2:])
        return torch._C._disabled_torch_function_impl(func, types, args, kwargs or {})

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


class _Operators(TorchDispatchMode):
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


class _FromNumbers(TorchFunctionMode):
    """``torch.tensor`` reaches no operator with its numbers."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func is torch.tensor and "device" in kwargs and torch.device(kwargs["device"]) == ELSEWHERE:
            return _Away(torch.tensor(*args, **kwargs | {"device": "cpu"}))
        return func(*args, **kwargs)


@contextmanager
def second_device():
    """Inside, ``device="meta"`` means elsewhere."""
    with _FromNumbers(), _Operators():
        yield


def moved(model: nn.Module) -> nn.Module:
    """The model with all its parameters and buffers elsewhere; use in place of ``model.to``."""
    for module in model.modules():
        for name, parameter in module._parameters.items():
            if parameter is not None and not isinstance(parameter, _Away):
                there = _Away(parameter.detach().clone())
                module._parameters[name] = nn.Parameter(there, requires_grad=parameter.requires_grad)
        for name, buffer in module._buffers.items():
            if buffer is not None and not isinstance(buffer, _Away):
                module._buffers[name] = _Away(buffer.detach().clone())
    return model


def _run(func, args, kwargs):
    name = str(func)
    leaves = tree_leaves((args, kwargs))
    assert not any(type(leaf) is torch.Tensor and leaf.is_meta for leaf in leaves), f"{name}: lost numbers"
    away = [leaf for leaf in leaves if isinstance(leaf, _Away)]
    if away and not name.startswith(_COPIES):
        _refuse_strangers(name, args, leaves)
    asked = kwargs.get("device")
    lands_away = bool(away) if asked is None else torch.device(asked) == ELSEWHERE
    kwargs = kwargs | ({} if asked is None else {"device": torch.device("cpu")})
    inner_args, inner_kwargs = tree_map(_unwrapped, (args, kwargs))
    result = func(*inner_args, **inner_kwargs)
    if func._schema.is_mutable and not func._schema.name.endswith("out") and len(func._schema.returns) == 1:
        return args[0]
    if name == _PACKING and lands_away:
        return _Away(result[0]), result[1]
    return (
        tree_map(lambda x: _Away(x) if isinstance(x, torch.Tensor) else x, result) if lands_away else result
    )


def _refuse_strangers(name, args, leaves):
    if name == _PACKING:
        assert not isinstance(args[1], _Away), f"{name}: lengths must be on the CPU"
        return
    if name.startswith(_TAKE_CPU_INDICES):
        leaves = [args[0], *args[2:3]]
    strangers = [
        leaf
        for leaf in leaves
        if isinstance(leaf, torch.Tensor) and not isinstance(leaf, _Away) and leaf.ndim
    ]
    if strangers:
        shapes = ", ".join(str(tuple(leaf.shape)) for leaf in strangers)
        raise RuntimeError(f"{name}: tensors of two devices; on the CPU are {shapes}")


def _with_tensors(index):
    """Lists in an index as tensors; torch would make them on the device ``meta``, where numbers are lost."""
    if isinstance(index, tuple):
        return tuple(torch.tensor(part) if isinstance(part, list) else part for part in index)
    return torch.tensor(index) if isinstance(index, list) else index


def _unwrapped(value):
    return value.inner if isinstance(value, _Away) else value
