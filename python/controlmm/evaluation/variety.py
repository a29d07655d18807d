"""How much motions differ: diversity over all texts, multimodality for one text.

Source: Guo et al., "Action2Motion", ACM MM 2020, as the text-to-motion papers use them.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

PAIRS, FEW_PAIRS = 300, 100  # of diversity; the smaller number for 300 samples or fewer
MULTIMODALITY_PAIRS = 10


def diversity(motions: Float[Tensor, "N E"], *, generator: torch.Generator) -> float:
    """Mean Euclidean distance of 300 random pairs (100 when there are 300 motions or fewer).

    Two independent sets of indices, each without repetition; so a pair may hold one motion twice. Of fewer
    than 100 motions, as many pairs as there are.

    Raises:
        ValueError: If there are fewer than two motions.
    """
    if motions.ndim != 2 or len(motions) < 2:
        raise ValueError(f"`motions` must be (N, E) with N >= 2, got {tuple(motions.shape)}.")
    pairs = min(PAIRS if len(motions) > PAIRS else FEW_PAIRS, len(motions))
    first, second = (torch.randperm(len(motions), generator=generator)[:pairs] for _ in range(2))
    return pair_distance(motions, first, second)


def multimodality(
    motions: Float[Tensor, "M S E"], *, generator: torch.Generator, pairs: int = MULTIMODALITY_PAIRS
) -> float:
    """Mean Euclidean distance of ``pairs`` random pairs among the ``S`` motions of each of ``M`` texts.

    The papers take 30 motions a text and 10 pairs, the same pairs for every text.

    Raises:
        ValueError: If a text has fewer motions than ``pairs``.
    """
    if motions.ndim != 3 or not len(motions) or motions.shape[1] < pairs:
        raise ValueError(
            f"`motions` must be (M, S, E) with M >= 1 and S >= {pairs} (`pairs`), got {tuple(motions.shape)}."
        )
    first, second = (torch.randperm(motions.shape[1], generator=generator)[:pairs] for _ in range(2))
    return pair_distance(motions.transpose(0, 1), first, second)


def pair_distance(
    motions: Float[Tensor, "N *M E"], first: Int[Tensor, "P"], second: Int[Tensor, "P"]
) -> float:
    """Mean Euclidean distance of the rows ``first`` to the rows ``second``."""
    motions = motions.double()
    return float((motions[first] - motions[second]).norm(dim=-1).mean())
