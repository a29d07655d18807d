"""What a solver may change of some clips, as one vector a clip."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.generation.code_spread import CodeSpread
from controlmm.generation.one_thread import one_thread


class Unknowns:
    """The latents of the tokens that may change or, given a ``spread``, their changes in its unit.

    No clip's numbers depend on the clips beside it.

    Args:
        latents: Where the clips start.
        keep: 1 where a token may change.
        spread: The unit of changes.
    """

    def __init__(
        self,
        latents: Float[Tensor, "B L C"],
        keep: Float[Tensor, "B L 1"],
        spread: CodeSpread | None = None,
    ) -> None:
        self._latents, self._is_free, self._spread = latents.detach(), keep[..., 0] > 0, spread
        self._counts: list[int] = self._is_free.sum(1).tolist()

    @property
    def starts(self) -> list[Float[Tensor, "N"]]:
        """The vector of each clip before anything has changed."""
        starts = self._by_clip(self._latents[self._is_free], range(len(self._latents)))
        return starts if self._spread is None else [torch.zeros_like(start) for start in starts]

    @one_thread()
    def placed(self, points: Sequence[Float[Tensor, "N"]], clips: Sequence[int]) -> Float[Tensor, "S L C"]:
        """Latents of some clips with ``points`` in place of their unknowns."""
        index = torch.tensor(clips, dtype=torch.int64)
        placed, is_free = self._latents[index], self._is_free[index]
        rows = torch.cat([placed.new_zeros(0), *points]).view(-1, placed.shape[-1])
        placed[is_free] = rows if self._spread is None else placed[is_free] + self._spread.change(rows)
        return placed

    @one_thread()
    def gradients(self, gradients: Float[Tensor, "S L C"], clips: Sequence[int]) -> list[Float[Tensor, "N"]]:
        """In the unknowns of some clips, given those in their latents; a clip may come more than once."""
        rows = gradients[self._is_free[torch.tensor(clips, dtype=torch.int64)]]
        return self._by_clip(rows if self._spread is None else self._spread.gradient(rows), clips)

    def _by_clip(self, rows: Float[Tensor, "M C"], clips: Sequence[int]) -> list[Float[Tensor, "N"]]:
        return [part.flatten() for part in rows.split([self._counts[clip] for clip in clips])]
