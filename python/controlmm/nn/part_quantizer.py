"""Vector quantisation with one codebook for each slice of the channels."""

from __future__ import annotations

from typing import cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from controlmm.nn.quantizer import EmaCodebook, Quantized, Quantizer, perplexity


class PartQuantizer(Quantizer):
    """``Q`` codebooks side by side: latents (B, L, Q C) <-> ids (B, L, Q)."""

    def __init__(self, *, parts: int, num_codes: int, dim: int, decay: float) -> None:
        super().__init__()
        self.books = nn.ModuleList(EmaCodebook(num_codes, dim, decay=decay) for _ in range(parts))

    def book(self, part: int) -> EmaCodebook:
        """The codebook of a part."""
        return cast(EmaCodebook, self.books[part])

    def forward(self, x: Float[Tensor, "B L QC"], valid: Bool[Tensor, "B L"] | None = None) -> Quantized:
        """Each slice's nearest code, straight-through; in training the codebooks follow (EMA)."""
        keep = x.new_ones(x.shape[:2], dtype=torch.bool) if valid is None else valid
        slices = x.float().chunk(len(self.books), dim=-1)
        parts = [self._quantize(self.book(part), piece, keep) for part, piece in enumerate(slices)]
        ids = torch.stack([chosen for chosen, _ in parts], dim=-1)
        errors = [
            (piece - codes)[keep].square().mean() for piece, (_, codes) in zip(slices, parts, strict=True)
        ]
        codes = torch.cat([codes for _, codes in parts], dim=-1)
        used = [perplexity(ids[..., part][keep], len(self.book(part).codes)) for part in range(len(parts))]
        return Quantized(
            (x + (codes - x).detach()) * keep[..., None],
            torch.where(keep[..., None], ids, -1),
            torch.stack(errors).mean(),
            torch.stack(used).mean(),
        )

    def lookup(self, ids: Int[Tensor, "B L Q"]) -> Float[Tensor, "B L QC"]:
        """Codes of all parts side by side; -1 gives zeros."""
        codes = [self.book(part).codes[ids[..., part].clamp(min=0)] for part in range(ids.shape[-1])]
        return (torch.stack(codes, dim=-2) * (ids >= 0)[..., None]).flatten(-2)

    def _quantize(self, book: EmaCodebook, x: Tensor, keep: Tensor) -> tuple[Tensor, Tensor]:
        vectors = x.detach()[keep]  # padding must not enter the codebooks
        if self.training and not book.is_initialized:
            book.initialize(vectors)
        chosen = book.nearest(vectors)
        ids = torch.zeros_like(keep, dtype=torch.long).masked_scatter_(keep, chosen)
        codes = book.codes[ids]
        if self.training:
            book.update(vectors, chosen)
        return ids, codes
