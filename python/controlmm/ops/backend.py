"""Which implementation runs: the C++ kernels or plain torch. Resolved here and nowhere else."""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from types import ModuleType
from typing import Literal, get_args

import torch
from torch import Tensor

from controlmm import __version__

Backend = Literal["auto", "native", "reference"]

_forced: ContextVar[Backend | None] = ContextVar("controlmm_backend", default=None)


def _load_core() -> tuple[ModuleType | None, str]:
    try:
        return importlib.import_module("controlmm._core"), ""
    except ImportError as error:
        return None, str(error)


_core, _core_missing_because = _load_core()


def core() -> ModuleType:
    """The C++ extension.

    Raises:
        ImportError: If it was not built or does not load here.
    """
    if _core is None:
        raise ImportError(
            f"The native kernels are not available ({_core_missing_because}). "
            "Install controlmm with a C++ compiler at hand, or use `backend='reference'`."
        )
    return _core


def _checked(name: str) -> Backend:
    if name not in get_args(Backend):
        raise ValueError(f"`backend` must be one of {get_args(Backend)}, got {name!r}.")
    return name  # type: ignore[return-value]


@contextlib.contextmanager
def use_backend(name: Backend) -> Iterator[None]:
    """Use one backend for every operator called in this context; other threads are not affected.

    Raises:
        ValueError: If ``name`` is not "auto", "native" or "reference".
    """
    token = _forced.set(_checked(name))
    try:
        yield
    finally:
        _forced.reset(token)


def requested_backend(backend: Backend | None) -> Backend:
    """The backend asked for: the argument, else the context, else ``CONTROLMM_BACKEND``, else "auto".

    Raises:
        ValueError: If the argument or the environment variable is no backend.
    """
    if backend is not None:
        return _checked(backend)
    forced = _forced.get()
    if forced is not None:
        return forced
    named = os.environ.get("CONTROLMM_BACKEND")
    return _checked(named) if named else "auto"


# torch.compile bakes the choice in while tracing. This is what torch.compiler.assume_constant_result sets;
# the decorator itself would import the compiler, which costs a second.
requested_backend._dynamo_marked_constant = True  # type: ignore[attr-defined]


def _obstacle_to_native(tensors: tuple[Tensor, ...]) -> str | None:
    """Why the kernels cannot take these tensors, or None if they can."""
    if _core is None:
        return f"the extension is not available ({_core_missing_because})"
    if torch.compiler.is_compiling():
        return _obstacle_to_tracing(tensors)
    if torch._C._are_functorch_transforms_active():
        return "torch.func transforms (vmap, grad, jvp) need plain torch operators"
    dtype = tensors[0].dtype
    for tensor in tensors:
        if tensor.device.type != "cpu":
            return f"a tensor is on {tensor.device}, the kernels run on the CPU"
        if tensor.dtype != dtype or dtype not in (torch.float32, torch.float64):
            return f"tensors must be all float32 or all float64, got {tensor.dtype}"
        if tensor.layout != torch.strided or tensor.is_neg():
            return "a tensor is not plain strided memory"
        if type(tensor) is not Tensor and type(tensor) is not torch.nn.Parameter:
            return f"a tensor is a {type(tensor).__name__}, whose own behaviour the kernels would bypass"
    return None


def _register_operators() -> bool:
    importlib.import_module("controlmm.ops.library")
    return True


_register_operators._dynamo_marked_constant = True  # type: ignore[attr-defined]


def _obstacle_to_tracing(tensors: tuple[Tensor, ...]) -> str | None:
    dtype = tensors[0].dtype
    fits = dtype in (torch.float32, torch.float64) and all(
        tensor.device.type == "cpu" and tensor.dtype == dtype for tensor in tensors
    )
    if not fits:
        return "tensors must be all float32 or all float64, on the CPU"
    _register_operators()  # now, not at import: torch.library takes a second to load
    return None


def refuse_second_derivative(operator: str) -> None:
    """Called in every native backward pass; autograd records there only if it is to be differentiated again.

    Raises:
        RuntimeError: If it is.
    """
    if torch.is_grad_enabled():
        raise RuntimeError(
            f"`{operator}` has no second derivative in its native form. Use `backend='reference'` for "
            "`create_graph=True`."
        )


def runs_native(backend: Backend | None, *tensors: Tensor) -> bool:
    """Whether the C++ kernels serve a call with these floating-point tensors.

    Raises:
        ValueError: If "native" was asked for and cannot run, or a name is no backend.
    """
    requested = requested_backend(backend)
    if requested == "reference":
        return False
    reason = _obstacle_to_native(tensors)
    if reason is not None and requested == "native":
        raise ValueError(f"`backend='native'` cannot run: {reason}. Use 'auto' or 'reference'.")
    return reason is None


def available_isas() -> tuple[str, ...]:
    """Instruction sets the kernels were built for and this processor runs, slowest first; empty without
    extension."""
    return tuple(_core.available_isas()) if _core is not None else ()


def active_isa() -> str | None:
    """The instruction set in use, or None without the extension.

    Raises:
        ValueError: If ``CONTROLMM_ISA`` names an unknown or unusable instruction set.
    """
    return str(_core.active_isa()) if _core is not None else None


@contextlib.contextmanager
def use_isa(name: str) -> Iterator[None]:
    """Run the kernels with one instruction set, in every thread; results stay the same, speed changes.

    Raises:
        ImportError: Without the extension.
        ValueError: If this machine does not run it.
    """
    previous = core().active_isa()
    core().set_isa(name)
    try:
        yield
    finally:
        core().set_isa(previous)


@dataclass(frozen=True)
class BuildInfo:
    """What is installed and in use."""

    version: str
    compiler: str | None  # None without the extension
    bindings: str | None  # "pybind11" or "nanobind"
    isa: str | None  # instruction set in use
    threads: int  # upper bound for one operator call

    def __str__(self) -> str:
        if self.compiler is None:
            return f"controlmm {self.version}, no native kernels (plain torch), {self.threads} threads"
        return (
            f"controlmm {self.version}, {self.compiler}, {self.bindings}, "
            f"instruction set {self.isa} of {'/'.join(available_isas())}, {self.threads} threads"
        )


def build_info() -> BuildInfo:
    """Version, compiler, binding package, instruction set and threads of this installation.

    Raises:
        ValueError: If ``CONTROLMM_ISA`` names an unknown or unusable instruction set.
    """
    if _core is None:
        return BuildInfo(__version__, None, None, None, torch.get_num_threads())
    return BuildInfo(
        _core.version(), _core.compiler(), _core.bindings(), _core.active_isa(), torch.get_num_threads()
    )
