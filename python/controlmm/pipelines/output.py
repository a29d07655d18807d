"""What a pipeline returns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.generation.exact import ExactReport
from controlmm.motion.motion import Motion

FREE = 1e-3  # metres; a joint that enters less deeply counts as clear


@dataclass(frozen=True, eq=False)
class GenerationResult:
    """The samples of one call.

    Attributes:
        motions: One :class:`Motion` a sample, in the order of the seeds.
        control_error: (S,) mean distance of the controlled joints to their targets, metres, measured on the
            motions as returned; 0 without controls.
        penetration: (S,) greatest depth to which a joint enters an obstacle in metres, measured likewise.
        latents: (S, L, C) latents that decode to the motions, but for their closed end and the floor.
        seconds_taken: Wall-clock seconds of the call.
        exact: What the closed end did to each sample; empty without it.
    """

    motions: tuple[Motion, ...]
    control_error: Float[Tensor, "S"]
    penetration: Float[Tensor, "S"]
    latents: Float[Tensor, "S L C"]
    seconds_taken: float
    exact: tuple[ExactReport, ...] = ()

    @property
    def best(self) -> Motion:
        """The sample with the smallest control error plus penetration (the first one without either)."""
        return self.motions[int((self.control_error + self.penetration).argmin())]

    @property
    def is_free(self) -> Bool[Tensor, "S"]:
        """Whether a sample stays clear of all obstacles, to a millimetre."""
        return self.penetration < FREE

    def __len__(self) -> int:
        return len(self.motions)

    def __iter__(self) -> Iterator[Motion]:
        return iter(self.motions)

    def __getitem__(self, index: int) -> Motion:
        return self.motions[index]
