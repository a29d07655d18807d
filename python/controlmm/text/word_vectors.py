"""Word vectors and word classes, as the published text-motion evaluator takes its sentences.

Source: Guo et al., CVPR 2022 (GloVe vectors of 4,199 words, 15 classes of words).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from safetensors.torch import save_file
from torch import Tensor

from controlmm.nn.checkpoint import read_weights

MAX_WORDS = 20
_POSITIONS = MAX_WORDS + 2  # with start and end mark
WORDS_FILE, _VECTORS_FILE = "words.txt", "words.safetensors"
_TAGS = (
    "VERB", "NOUN", "DET", "ADP", "NUM", "AUX", "PRON", "ADJ", "ADV", "Loc_VIP", "Body_VIP", "Obj_VIP",
    "Act_VIP", "Desc_VIP", "OTHER",
)  # fmt: skip
_SPECIAL = {  # words whose class counts instead of their part of speech
    "Loc_VIP": "left right clockwise counterclockwise anticlockwise forward back backward up down straight "
    "curve",
    "Body_VIP": "arm chin foot feet face hand mouth leg waist eye knee shoulder thigh",
    "Obj_VIP": "stair dumbbell chair window floor car ball handrail baseball basketball",
    "Act_VIP": "walk run swing pick bring kick put squat throw hop dance jump turn stumble stop sit lift "
    "lower raise wash stand kneel stroll rub bend balance flap jog shuffle lean rotate spin spread climb",
    "Desc_VIP": "slowly carefully fast careful slow quickly happy angry sad happily angrily sadly",
}
_SPECIAL_TAG = {word: tag for tag, words in _SPECIAL.items() for word in words.split()}


@dataclass(frozen=True)
class Sentences:
    """Sentences as word vectors, padded to 22 positions.

    Attributes:
        words: (B, 22, 300) vectors.
        tags: (B, 22, 15) one-hot classes.
        lengths: (B,) positions that count, start and end mark among them.
    """

    words: Float[Tensor, "B S 300"]
    tags: Float[Tensor, "B S 15"]
    lengths: Int[Tensor, "B"]


class WordVectors:
    """A table of word vectors; a word that it lacks gets the vector of ``unk``.

    Raises:
        ValueError: If words and vectors differ in number, or ``sos``, ``eos`` or ``unk`` is missing.
    """

    def __init__(self, words: Sequence[str], vectors: Float[Tensor, "N 300"]) -> None:
        if vectors.ndim != 2 or len(words) != len(vectors):
            raise ValueError(
                f"`vectors` must be (N, C) for the {len(words)} words, got {tuple(vectors.shape)}."
            )
        self._row = {word: row for row, word in enumerate(words)}
        missing = [mark for mark in ("sos", "eos", "unk") if mark not in self._row]
        if missing:
            raise ValueError(f"`words` lacks {', '.join(missing)}; is it the evaluator's vocabulary?")
        self._words, self._vectors = list(words), vectors.float()

    @classmethod
    def load(cls, folder: str | Path) -> WordVectors:
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: If a file is missing.
            ValueError: If one is damaged.
        """
        listing = Path(folder) / WORDS_FILE
        if not listing.is_file():
            raise FileNotFoundError(f"No {WORDS_FILE} in {folder}.")
        vectors = read_weights(Path(folder) / _VECTORS_FILE)["vectors"]
        return cls(listing.read_text(encoding="utf-8").splitlines(), vectors)

    def save(self, folder: str | Path) -> None:
        """Write ``words.txt`` (a word a line) and ``words.safetensors`` into ``folder``."""
        (Path(folder) / WORDS_FILE).write_text("\n".join(self._words) + "\n", encoding="utf-8")
        save_file({"vectors": self._vectors.contiguous()}, Path(folder) / _VECTORS_FILE)

    def encode(self, sentences: Sequence[Sequence[str]]) -> Sentences:
        """Vectors and classes of sentences, each a sequence of ``word/TAG`` tokens.

        Of a sentence of 20 words or more the first 20 are taken. A word's own class (directions, body parts,
        actions ...) replaces its part of speech; unknown tags and unknown words are ``OTHER``.

        Raises:
            ValueError: If a sentence has no tokens, or a token no tag.
        """
        words = torch.zeros(len(sentences), _POSITIONS, self._vectors.shape[1])
        tags = torch.zeros(len(sentences), _POSITIONS, len(_TAGS))
        lengths = []
        for row, tokens in enumerate(sentences):
            if not tokens:
                raise ValueError(
                    f"Sentence {row} has no word/TAG tokens, which this evaluator needs. HumanML3D's and "
                    "KIT-ML's text files have them; use the in-project evaluator for other captions."
                )
            marked = ["sos/OTHER", *tokens[:MAX_WORDS], "eos/OTHER"]
            lengths.append(len(marked))
            marked += ["unk/OTHER"] * (_POSITIONS - len(marked))
            for position, token in enumerate(marked):
                vector, tag = self._looked_up(token)
                words[row, position] = self._vectors[vector]
                tags[row, position, tag] = 1
        return Sentences(words, tags, torch.tensor(lengths))

    def _looked_up(self, token: str) -> tuple[int, int]:
        word, slash, tag = token.rpartition("/")
        if not slash:
            raise ValueError(f"A token must be word/TAG, got {token!r}.")
        if word not in self._row:
            return self._row["unk"], _TAGS.index("OTHER")
        tag = _SPECIAL_TAG.get(word, tag if tag in _TAGS else "OTHER")
        return self._row[word], _TAGS.index(tag)
