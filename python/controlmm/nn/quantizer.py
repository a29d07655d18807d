"""Residual vector quantisation with codebooks kept by exponential moving averages (no gradient)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

_RESET_BELOW = 1.0  # a code with a smaller running count is dead and takes a vector of the batch


@dataclass(frozen=True)
class Quantized:
    """Result of residual quantisation."""

    latents: Float[Tensor, "B L C"]  # sum of the chosen codes; gradient passes straight through
    ids: Int[Tensor, "B L Q"]  # -1 in layers dropped by quantise dropout and in padding
    commitment: Float[Tensor, ""]  # mean over the active layers
    perplexity: Float[Tensor, ""]  # of each batch's code histogram, mean over the active layers


class Quantizer(nn.Module):
    """Latents (B, L, C) -> :class:`Quantized`; calling it in training mode also updates its codebooks."""

    def lookup(self, ids: Int[Tensor, "B L Q"]) -> Float[Tensor, "B L C"]:
        """Latents of code ids; -1 adds nothing."""
        raise NotImplementedError


@dataclass
class CodebookUpdate:
    """What batches have in store for a codebook."""

    count: Float[Tensor, "K"]  # vectors that chose each code
    total: Float[Tensor, "K C"]  # their sums
    rows: Float[Tensor, "K C"]  # random vectors of the first batch, for codes that died
    batches: Float[Tensor, ""]


class EmaCodebook(nn.Module):
    """``K`` codes, each the running mean of the vectors that chose it; all state is in the state dict.

    Training moves the codes at once, unless ``is_deferred``: then updates gather until :meth:`apply_update`,
    so that a training loop can join those of several batches or processes, or drop those of a bad step.
    """

    codes: Tensor
    ema_sum: Tensor
    ema_count: Tensor
    is_initialized: Tensor

    def __init__(self, num_codes: int, dim: int, *, decay: float, takes_first_rows: bool = False) -> None:
        super().__init__()
        self.decay = decay
        self._rows: Callable[[Tensor, int], Tensor] = _first_rows if takes_first_rows else _random_rows
        self.is_deferred = False
        self._pending: CodebookUpdate | None = None
        self.register_buffer("codes", torch.zeros(num_codes, dim))
        self.register_buffer("ema_sum", torch.zeros(num_codes, dim))
        self.register_buffer("ema_count", torch.ones(num_codes))
        self.register_buffer("is_initialized", torch.tensor(False))

    def nearest(self, x: Float[Tensor, "N C"], *, temperature: float = 0.0) -> Int[Tensor, "N"]:
        """Index of the nearest code; with a temperature, drawn from softmax(-distance / temperature)."""
        distance = x.square().sum(1, keepdim=True) - 2 * x @ self.codes.T + self.codes.square().sum(1)
        if temperature == 0:
            return distance.argmin(1)
        # One uniform number a row and a search in the cumulated probabilities: Gumbel noise for every code
        # gives the same distribution at a quarter of a training step's time.
        cumulated = torch.softmax(-distance / temperature, dim=1).cumsum(1)
        threshold = torch.rand_like(cumulated[:, :1]) * cumulated[:, -1:]
        return torch.searchsorted(cumulated, threshold).squeeze(1).clamp(max=len(self.codes) - 1)

    @torch.no_grad()
    def update(self, x: Float[Tensor, "N C"], ids: Int[Tensor, "N"]) -> None:
        """Move the codes towards the vectors that chose them; dead ones become rows of ``x``."""
        num_codes = len(self.codes)
        count = torch.bincount(ids, minlength=num_codes).to(x.dtype)
        total = torch.zeros_like(self.codes).index_add_(0, ids, x)
        fresh = CodebookUpdate(count, total, self._rows(x, num_codes), torch.ones_like(count[0]))
        if not self.is_deferred:
            self.apply_update(fresh)
        elif self._pending is None:
            self._pending = fresh
        else:
            self._pending.count += fresh.count
            self._pending.total += fresh.total
            self._pending.batches += 1

    def pending(self) -> CodebookUpdate:
        """The updates gathered so far; zeros when there are none."""
        zeros = torch.zeros_like
        return self._pending or CodebookUpdate(
            zeros(self.ema_count), zeros(self.codes), zeros(self.codes), zeros(self.ema_count[0])
        )

    def forget_pending(self) -> None:
        """Drop the updates gathered so far."""
        self._pending = None

    @torch.no_grad()
    def apply_update(self, update: CodebookUpdate) -> None:
        """Move the codes; nothing happens for an update without any batch."""
        if update.batches == 0:
            return
        self.ema_sum.lerp_(update.total, 1 - self.decay)
        self.ema_count.lerp_(update.count, 1 - self.decay)
        alive = (self.ema_count >= _RESET_BELOW)[:, None]
        means = self.ema_sum / self.ema_count.clamp(min=_RESET_BELOW)[:, None]
        self.codes.copy_(torch.where(alive, means, update.rows))

    @torch.no_grad()
    def initialize(self, x: Float[Tensor, "N C"]) -> None:
        """Start from vectors of the first batch."""
        self.codes.copy_(self._rows(x, len(self.codes)))
        self.ema_sum.copy_(self.codes)
        self.ema_count.fill_(1.0)
        self.is_initialized.fill_(True)


class ResidualQuantizer(Quantizer):
    """``Q`` codebooks; each quantises what the ones before it left over."""

    def __init__(
        self,
        *,
        num_quantizers: int,
        num_codes: int,
        dim: int,
        decay: float,
        shared: bool,
        temperature: float,
        dropout: float,
        takes_first_rows: bool = False,
    ) -> None:
        super().__init__()
        self.num_quantizers, self.temperature, self.dropout = num_quantizers, temperature, dropout
        self.is_shared = shared
        books = 1 if shared else num_quantizers
        self.books = nn.ModuleList(
            EmaCodebook(num_codes, dim, decay=decay, takes_first_rows=takes_first_rows) for _ in range(books)
        )

    def book(self, layer: int) -> EmaCodebook:
        """The codebook of a layer (the only one when they are shared)."""
        return cast(EmaCodebook, self.books[0 if self.is_shared else layer])

    def forward(self, x: Float[Tensor, "B L C"], valid: Bool[Tensor, "B L"] | None = None) -> Quantized:
        """Quantise; in training also update the codebooks and draw the codes at random.

        Straight-through in every layer: the encoder receives the gradient once for each active layer, as in
        the published training.
        """
        residual = x if valid is None else x * valid[..., None]
        keep = torch.ones_like(x[..., 0], dtype=torch.bool) if valid is None else valid
        latents = torch.zeros_like(x)
        ids, commitments, perplexities = [], [], []
        for layer in range(self._active_layers()):
            chosen, codes = self._quantize_layer(self.book(layer), residual, keep)
            commitments.append((residual - codes.detach())[keep].square().mean())
            perplexities.append(perplexity(chosen[keep], len(self.book(layer).codes)))
            latents = latents + residual + (codes - residual).detach()
            residual = residual - codes.detach()
            ids.append(torch.where(keep, chosen, -1))
        while len(ids) < self.num_quantizers:
            ids.append(torch.full_like(ids[0], -1))
        return Quantized(
            latents * keep[..., None],
            torch.stack(ids, dim=-1),
            torch.stack(commitments).mean(),
            torch.stack(perplexities).mean(),
        )

    def lookup(self, ids: Int[Tensor, "B L Q"]) -> Float[Tensor, "B L C"]:
        """Sum of the codes; -1 adds nothing."""
        layers = [self.lookup_layer(ids[..., layer], layer) for layer in range(ids.shape[-1])]
        return torch.stack(layers).sum(0)

    def lookup_layer(self, ids: Int[Tensor, "B L"], layer: int) -> Float[Tensor, "B L C"]:
        """Codes of one layer; -1 gives zeros."""
        return self.book(layer).codes[ids.clamp(min=0)] * (ids >= 0)[..., None]

    def _quantize_layer(self, book: EmaCodebook, residual: Tensor, keep: Tensor) -> tuple[Tensor, Tensor]:
        vectors = residual.detach()[keep].float()  # padding must not enter the codebooks
        if self.training and not book.is_initialized:
            book.initialize(vectors)
        chosen = book.nearest(vectors, temperature=self.temperature if self.training else 0.0)
        ids = torch.zeros_like(keep, dtype=torch.long).masked_scatter_(keep, chosen)
        codes = book.codes[ids] * keep[..., None]
        if self.training:
            book.update(vectors, chosen)
        return ids, codes

    def _active_layers(self) -> int:
        if self.training and torch.rand(()) < self.dropout:
            return int(torch.randint(self.num_quantizers, ())) + 1
        return self.num_quantizers


def _random_rows(x: Float[Tensor, "N C"], count: int) -> Float[Tensor, "K C"]:
    """``count`` rows of ``x`` in random order; fewer rows are repeated with a little noise."""
    x = _at_least(x, count)
    return x[torch.randperm(len(x))[:count]]


def _first_rows(x: Float[Tensor, "N C"], count: int) -> Float[Tensor, "K C"]:
    """The first ``count`` rows, as the published training takes them."""
    return _at_least(x, count)[:count]


def _at_least(x: Float[Tensor, "N C"], count: int) -> Float[Tensor, "N C"]:
    if len(x) >= count:
        return x
    x = x.repeat((count + len(x) - 1) // len(x), 1)
    noisy: Tensor = x + torch.randn_like(x) * 0.01 / x.shape[1] ** 0.5
    return noisy


def perplexity(ids: Int[Tensor, "N"], num_codes: int) -> Float[Tensor, ""]:
    """Exponential of the entropy of the codes' histogram: how many codes are in use."""
    share = torch.bincount(ids, minlength=num_codes) / max(1, len(ids))
    return (-(share * (share + 1e-7).log()).sum()).exp()
