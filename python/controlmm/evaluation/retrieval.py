"""How well a text finds its motion: R-precision and matching distance.

Source: Guo et al., "Generating Diverse and Natural 3D Human Motions from Text", CVPR 2022.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

GROUP = 32  # one right motion among 31 others; another group size gives another number


def r_precision(
    texts: Float[Tensor, "N E"], motions: Float[Tensor, "N E"], *, top: int = 3, group: int = GROUP
) -> Float[Tensor, "K"]:
    """Share of texts whose own motion is among the ``k`` nearest of its group, for k = 1 .. ``top``.

    Consecutive groups of ``group`` pairs; an incomplete last group is left out. Distances are Euclidean. A
    motion that is exactly as near as the right one counts as farther: only what is nearer pushes it back.

    Args:
        texts: Text embeddings.
        motions: Motion embeddings, row by row the motions of ``texts``.
        top: Largest ``k``.
        group: Pairs in a group; 32 in all papers.

    Raises:
        ValueError: If the shapes differ or there is no complete group.
    """
    _check_pairs(texts, motions)
    count = len(texts) // group * group
    if not count:
        raise ValueError(f"R-precision needs a complete group of {group} pairs, got {len(texts)} pairs.")
    groups = (x[:count].double().unflatten(0, (-1, group)) for x in (texts, motions))
    distances = _distances(*groups)  # (G, text, motion)
    own = distances.diagonal(dim1=1, dim2=2)[..., None]
    rank = (distances < own).sum(-1)
    return torch.stack([(rank < k).double().mean() for k in range(1, top + 1)])


def matching_distance(texts: Float[Tensor, "N E"], motions: Float[Tensor, "N E"]) -> float:
    """MM-Dist: mean Euclidean distance of a text's embedding to that of its motion.

    Raises:
        ValueError: If the shapes differ or there is no pair.
    """
    _check_pairs(texts, motions)
    return float((texts.double() - motions.double()).norm(dim=-1).mean())


def _distances(a: Float[Tensor, "G N E"], b: Float[Tensor, "G M E"]) -> Float[Tensor, "G N M"]:
    # Differences, not scalar products: in those, near embeddings cancel to noise.
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


def _check_pairs(texts: Tensor, motions: Tensor) -> None:
    if texts.ndim != 2 or texts.shape != motions.shape or not len(texts):
        raise ValueError(
            "`texts` and `motions` must both be (N, E) with N >= 1, "
            f"got {tuple(texts.shape)} and {tuple(motions.shape)}."
        )
