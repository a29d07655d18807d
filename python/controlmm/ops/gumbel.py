"""Gumbel straight-through sampling of codebook rows."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from controlmm.ops.backend import Backend, core, refuse_second_derivative, runs_native
from controlmm.ops.philox import gumbel_noise_reference

_MOST_CLIPS = 2**31


def gumbel_noise(
    shape: tuple[int, int, int],
    *,
    seed: int,
    first_clip: int = 0,
    dtype: torch.dtype = torch.float32,
    backend: Backend | None = None,
) -> Float[Tensor, "B L K"]:
    """Standard Gumbel noise, a function of (seed, clip, token, code) only (Philox 4x32-10).

    The same for both backends up to rounding, and for any threads or batch split.

    Args:
        shape: Clips, tokens and codes.
        seed: 64-bit key of the noise.
        first_clip: Number of the first clip in the whole batch.
        dtype: float32 or float64.
        backend: "native", "reference" or "auto"; ``None`` asks the context and the environment.

    Raises:
        ValueError: If the seed or clip number is out of range, or "native" was asked for and cannot run.
    """
    _check_source(seed, first_clip)
    out = torch.empty(shape, dtype=dtype)
    if not runs_native(backend, out):
        return gumbel_noise_reference(shape, seed, first_clip, dtype)
    core().gumbel_noise(seed, first_clip, out, torch.get_num_threads())
    return out


def gumbel_straight_through(
    logits: Float[Tensor, "B L K"],
    codebook: Float[Tensor, "K C"],
    *,
    temperature: float = 1.0,
    seed: int,
    first_clip: int = 0,
    hard: bool = True,
    backend: Backend | None = None,
) -> tuple[Float[Tensor, "B L C"], Int[Tensor, "B L"]]:
    """Embeddings of randomly drawn codes, and the codes; differentiable in logits and codebook.

    With noise g, the code is argmax(logits + g): a sample of softmax(logits). Forward gives its codebook row
    (or, soft, the mean row under p = softmax((logits + g) / temperature)); backward always goes through p
    (straight-through estimator; Jang et al. 2017; ControlMM, equation 3).

    Args:
        logits: Unnormalised log-probabilities.
        codebook: One row for each code.
        temperature: Above 0; values down to 1e-8 are safe.
        seed: The noise is a function of (seed, clip, token, code): any threads or batch split give the same.
        first_clip: Number of the first clip in the whole batch, when a batch is split.
        hard: False gives soft embeddings.
        backend: "native", "reference" or "auto"; ``None`` asks the context and the environment.

    Raises:
        TypeError: If the dtypes are not one floating-point dtype.
        ValueError: If a shape or value does not fit, or "native" was asked for and cannot run.
    """
    _check_arguments(logits, codebook, temperature)
    _check_source(seed, first_clip)
    if not runs_native(backend, logits, codebook):
        return _gumbel_reference(logits, codebook, temperature, seed, first_clip, hard)
    arguments = (logits, codebook, temperature, seed, first_clip, hard)
    if torch.compiler.is_compiling():
        signed_seed = seed - 2**64 if seed >= 2**63 else seed  # operator schemas know signed integers only
        traced = torch.ops.controlmm.gumbel_straight_through(
            logits, codebook, temperature, signed_seed, first_clip, hard
        )
        return traced[0], traced[1]
    if torch.is_grad_enabled() and (logits.requires_grad or codebook.requires_grad):
        embeddings, ids = _GumbelStraightThrough.apply(*arguments)
        return embeddings, ids
    embeddings, ids, _ = gumbel_forward(*arguments, keep_probabilities=False)
    return embeddings, ids


def _check_source(seed: int, first_clip: int) -> None:
    if not 0 <= seed < 2**64:
        raise ValueError(f"`seed` must be between 0 and 2**64 - 1, got {seed}.")
    if not 0 <= first_clip < _MOST_CLIPS:
        raise ValueError(f"`first_clip` must be between 0 and {_MOST_CLIPS - 1}, got {first_clip}.")


def _check_arguments(logits: Tensor, codebook: Tensor, temperature: float) -> None:
    if not logits.is_floating_point() or codebook.dtype != logits.dtype:
        raise TypeError(
            "`logits` and `codebook` must share one floating-point dtype, "
            f"got {logits.dtype} and {codebook.dtype}."
        )
    if logits.ndim != 3 or codebook.ndim != 2 or logits.shape[2] != codebook.shape[0] or logits.shape[2] < 1:
        raise ValueError(
            "`logits` must have shape (B, L, K) and `codebook` (K, C) with K >= 1, "
            f"got {tuple(logits.shape)} and {tuple(codebook.shape)}."
        )
    if not temperature >= 1e-8:
        raise ValueError(f"`temperature` must be at least 1e-8, got {temperature}.")


def _gumbel_reference(
    logits: Tensor, codebook: Tensor, temperature: float, seed: int, first_clip: int, hard: bool
) -> tuple[Tensor, Tensor]:
    batch, tokens, codes = logits.shape
    noise = gumbel_noise_reference((batch, tokens, codes), seed, first_clip, logits.dtype).to(logits.device)
    disturbed = logits + noise
    ids = disturbed.argmax(-1)
    soft = (disturbed / temperature).softmax(-1)
    if not hard:
        return soft @ codebook, ids
    drawn = torch.nn.functional.one_hot(ids, codes).to(soft)
    return (drawn + (soft - soft.detach())) @ codebook, ids


def gumbel_forward(
    logits: Tensor,
    codebook: Tensor,
    temperature: float,
    seed: int,
    first_clip: int,
    hard: bool,
    *,
    keep_probabilities: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """The kernel alone: embeddings, codes and, if they are kept or needed, soft probabilities (else no
    codes)."""
    batch, tokens, codes = logits.shape
    rows = logits if logits.stride(2) == 1 else logits.contiguous()
    wants_soft = keep_probabilities or not hard
    ids = logits.new_empty((batch, tokens), dtype=torch.int64)
    embeddings = logits.new_empty((batch, tokens, codebook.shape[1] if hard else 0))
    probabilities = logits.new_empty((batch, tokens, codes if wants_soft else 0))
    core().gumbel_straight_through(
        rows, codebook.contiguous(), temperature, seed, first_clip, ids, embeddings, probabilities,
        torch.get_num_threads(),
    )  # fmt: skip
    return embeddings if hard else probabilities @ codebook, ids, probabilities


def gumbel_backward(
    grad_embeddings: Tensor, codebook: Tensor, probabilities: Tensor, temperature: float
) -> Float[Tensor, "B L K"]:
    """Gradient with respect to the logits: through the codebook, then through the softmax."""
    codes = probabilities.shape[-1]
    gradient = grad_embeddings.reshape(-1, codebook.shape[1]) @ codebook.T
    rows = probabilities.reshape(-1, codes)
    core().softmax_backward(rows, temperature, gradient, torch.get_num_threads())
    return gradient.reshape(probabilities.shape)


def codebook_gradient(grad_embeddings: Tensor, ids: Tensor, probabilities: Tensor, hard: bool) -> Tensor:
    """Gradient with respect to the codebook: rows that were drawn, or all by their probability."""
    codes, channels = probabilities.shape[-1], grad_embeddings.shape[-1]
    flat = grad_embeddings.reshape(-1, channels)
    if not hard:
        return probabilities.reshape(-1, codes).T @ flat
    return flat.new_zeros((codes, channels)).index_add_(0, ids.reshape(-1), flat)


class _GumbelStraightThrough(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, logits: Tensor, codebook: Tensor, temperature: float, seed: int, first_clip: int, hard: bool
    ) -> tuple[Tensor, Tensor]:
        embeddings, ids, probabilities = gumbel_forward(
            logits, codebook, temperature, seed, first_clip, hard, keep_probabilities=True
        )
        ctx.save_for_backward(codebook, ids, probabilities)
        ctx.temperature, ctx.hard = temperature, hard
        ctx.mark_non_differentiable(ids)
        return embeddings, ids

    @staticmethod
    def backward(
        ctx: Any, grad_embeddings: Tensor, _: Tensor
    ) -> tuple[Tensor | None, Tensor | None, None, None, None, None]:
        refuse_second_derivative("gumbel_straight_through")
        codebook, ids, probabilities = ctx.saved_tensors
        grad_logits = grad_codebook = None
        if ctx.needs_input_grad[0]:
            grad_logits = gumbel_backward(grad_embeddings, codebook, probabilities, ctx.temperature)
        if ctx.needs_input_grad[1]:
            grad_codebook = codebook_gradient(grad_embeddings, ids, probabilities, ctx.hard)
        return grad_logits, grad_codebook, None, None, None, None
