"""Counter-based random numbers in plain torch: the specification of the Gumbel kernel's noise."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

_WORD = 0xFFFFFFFF
_FACTORS = (0xD2511F53, 0xCD9E8D57)
_KEY_STEPS = (0x9E3779B9, 0xBB67AE85)
_GROUP = 64  # codes that share one block of sixteen counters
_LANES = 16


def _product(words: Int[Tensor, "*S"], factor: int) -> tuple[Int[Tensor, "*S"], Int[Tensor, "*S"]]:
    """High and low 32 bits of words * factor, in halves so that int64 does not overflow."""
    by_low, by_high = words * (factor & 0xFFFF), words * (factor >> 16)
    low = (by_low + ((by_high & 0xFFFF) << 16)) & _WORD
    return ((by_low >> 16) + by_high) >> 16, low


def philox_4x32_10(counter: tuple[Tensor, ...], key: tuple[int, int]) -> tuple[Tensor, ...]:
    """Four random 32-bit words (in int64) for each counter of four words.

    Source: Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
    """
    c0, c1, c2, c3 = counter
    k0, k1 = key
    for _ in range(10):
        high0, low0 = _product(c0, _FACTORS[0])
        high1, low1 = _product(c2, _FACTORS[1])
        c0, c1, c2, c3 = high1 ^ c1 ^ k0, low1, high0 ^ c3 ^ k1, low0
        k0, k1 = (k0 + _KEY_STEPS[0]) & _WORD, (k1 + _KEY_STEPS[1]) & _WORD
    return c0, c1, c2, c3


def gumbel_noise_reference(
    shape: tuple[int, int, int], seed: int, first_clip: int, dtype: torch.dtype
) -> Float[Tensor, "B L K"]:
    """Standard Gumbel noise -log(-log(u)), u a function of (seed, clip, token, code) alone."""
    batch, tokens, codes = shape
    groups = -(-codes // _GROUP)
    blocks = torch.arange(groups * _LANES).reshape(1, 1, groups, _LANES)
    clips = torch.arange(first_clip, first_clip + batch).reshape(-1, 1, 1, 1)
    places = torch.arange(tokens).reshape(1, -1, 1, 1)
    counter = torch.broadcast_tensors(blocks, places, clips, torch.zeros(1, 1, 1, 1, dtype=torch.int64))
    words = torch.stack(philox_4x32_10(counter, (seed & _WORD, seed >> 32)), dim=3)  # (B, L, groups, 4, 16)
    words = words.reshape(batch, tokens, groups * _GROUP)[..., :codes]
    uniform = ((words >> 9).to(dtype) + 0.5) * 2.0**-23  # exact, and never 0 or 1
    return -(-uniform.log()).log()
