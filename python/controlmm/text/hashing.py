"""Text features by hashing: no weights, the same on every machine. For tests and demonstrations.

Source: feature hashing (Weinberger et al., ICML 2009) of words and character n-grams (as in fastText,
Bojanowski et al., 2017), each with a row of a fixed random sign matrix (Achlioptas, 2003).
"""

from __future__ import annotations

import hashlib
import itertools
import math
import re
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from torch.nn.utils.rnn import pad_sequence

from controlmm.text.encoder import TextFeatures, check_prompts, no_features

VERSION = 1  # raise it when a prompt's features change
_SHORTEST_GRAM, _LONGEST_GRAM = 3, 4
_PAIR_WEIGHT = 0.5  # below 1, so that shared words count more than their order


class HashingTextEncoder:
    """Bag of hashed words, neighbouring words and character n-grams; ``pooled`` has unit length.

    Prompts that share words or stems get similar features; there is no meaning beyond the letters.
    """

    name = "hashing"

    def __init__(self, dim: int = 64) -> None:
        """Make an encoder of width ``dim``.

        Raises:
            ValueError: If ``dim`` is not positive.
        """
        if dim < 1:
            raise ValueError(f"`dim` must be at least 1, got {dim}.")
        self.dim = dim

    def encode(self, prompts: Sequence[str]) -> TextFeatures:
        """One token for each word; all zeros for a prompt without letters or digits.

        Raises:
            TypeError: If ``prompts`` is not a sequence of strings.
        """
        words = [re.findall(r"\w+", prompt.lower()) for prompt in check_prompts(prompts)]
        if not words:
            return no_features(self.dim)
        tokens = pad_sequence([self._word_vectors(row) for row in words], batch_first=True)
        pairs = torch.stack([self._pair_vector(row) for row in words])
        lengths = torch.tensor([len(row) for row in words])
        mask = torch.arange(tokens.shape[1]) < lengths[:, None]
        return TextFeatures(functional.normalize(tokens.sum(1) + pairs, dim=-1), tokens, mask)

    def config(self) -> dict[str, Any]:
        """Kind, width and the version of the hashing scheme."""
        return {"kind": "hashing", "dim": self.dim, "version": VERSION}

    def _word_vectors(self, words: list[str]) -> Float[Tensor, "S C"]:
        vectors = [_word_vector(word, self.dim) for word in words]
        return torch.stack(vectors) if vectors else torch.zeros(0, self.dim)

    def _pair_vector(self, words: list[str]) -> Float[Tensor, "C"]:
        """Pairs of neighbours make the order of the words count ("turns left then walks right")."""
        pairs = [f"pair:{first} {second}" for first, second in itertools.pairwise(words)]
        signs = [_signs(pair, self.dim) for pair in pairs]
        if not signs:
            return torch.zeros(self.dim)
        return torch.stack(signs).sum(0) * (_PAIR_WEIGHT / math.sqrt(self.dim))


@lru_cache(maxsize=65536)
def _word_vector(word: str, dim: int) -> Float[Tensor, "C"]:
    """The unit vector of one word: half the word itself, half its character n-grams."""
    marked = f"<{word}>"
    grams = [
        f"gram:{marked[start : start + size]}"
        for size in range(_SHORTEST_GRAM, _LONGEST_GRAM + 1)
        for start in range(len(marked) - size + 1)
    ]
    spelling = functional.normalize(torch.stack([_signs(gram, dim) for gram in grams]).sum(0), dim=0)
    return functional.normalize(_signs(f"word:{word}", dim) / math.sqrt(dim) + spelling, dim=0)


def _signs(feature: str, dim: int) -> Float[Tensor, "C"]:
    """The feature's row of the sign matrix: ``dim`` values of +1 or -1."""
    stream = hashlib.shake_256(feature.encode()).digest((dim + 7) // 8)
    bits = np.unpackbits(np.frombuffer(stream, dtype=np.uint8), count=dim)
    return torch.from_numpy(bits.astype(np.float32) * 2 - 1)
