"""Evaluators: networks that put motions and sentences into one space, where the papers' metrics live.

Numbers of two evaluators never compare, not even those of two trainings of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from controlmm.data.clip import Caption
from controlmm.models.motion_text_matcher import MotionTextMatcher
from controlmm.models.text_motion_matching import TextMotionMatching
from controlmm.nn.checkpoint import CONFIG_FILE
from controlmm.pipelines.folder import shipped_folder
from controlmm.text import TextEncoder, load_text_encoder
from controlmm.text.word_vectors import WORDS_FILE, WordVectors

SHIPPED = "evaluator"  # folder of the evaluator in the wheel


class Evaluator(Protocol):
    """What the protocol asks for; rows of the results are in the order of the input."""

    name: str
    caution: str  # a sentence for the foot of every table

    @property
    def feature_dim(self) -> int:
        """Width ``D`` of the features that it takes."""

    def embed_motions(
        self, features: Float[Tensor, "B T D"], lengths: Int[Tensor, "B"], *, sees_padding: bool = False
    ) -> Float[Tensor, "B E"]:
        """Embeddings of de-normalised features; with ``sees_padding`` what lies beyond a clip may matter."""

    def embed_captions(self, captions: Sequence[Caption]) -> Float[Tensor, "B E"]:
        """Embeddings of sentences."""


class LearnedEvaluator:
    """The in-project evaluator: :class:`MotionTextMatcher` with the text encoder that it was trained with."""

    name = "in-project evaluator"
    caution = (
        "Measured by the in-project evaluator, trained on the training split of this project's data: its "
        "numbers compare with each other and with the row of real motion, never with published ones."
    )

    def __init__(self, matcher: MotionTextMatcher, text_encoder: TextEncoder) -> None:
        self._matcher = matcher.eval().requires_grad_(False)
        self._text_encoder = text_encoder

    @property
    def feature_dim(self) -> int:
        """See :class:`Evaluator`."""
        return self._matcher.config.feature_dim

    @torch.no_grad()
    def embed_motions(
        self, features: Float[Tensor, "B T D"], lengths: Int[Tensor, "B"], *, sees_padding: bool = False
    ) -> Float[Tensor, "B E"]:
        """See :class:`Evaluator`; padding never matters here."""
        del sees_padding
        return self._matcher.embed_motions(features, lengths)

    @torch.no_grad()
    def embed_captions(self, captions: Sequence[Caption]) -> Float[Tensor, "B E"]:
        """See :class:`Evaluator`."""
        pooled = self._text_encoder.encode([caption.text for caption in captions]).pooled
        return self._matcher.embed_texts(pooled)


class PublishedEvaluator:
    """The networks of Guo et al. (CVPR 2022) with their word vectors, see ``controlmm convert-evaluator``."""

    name = "published evaluator"
    caution = (
        "Measured by the published text-motion networks. Real HumanML3D test motion has R-precision top-3 "
        "0.797 and diversity 9.503 there (KIT-ML 0.779 and 11.08): check that row before trusting others."
    )

    def __init__(self, network: TextMotionMatching, words: WordVectors) -> None:
        self._network = network.eval().requires_grad_(False)
        self._words = words

    @property
    def feature_dim(self) -> int:
        """See :class:`Evaluator`."""
        return self._network.config.feature_dim

    @torch.no_grad()
    def embed_motions(
        self, features: Float[Tensor, "B T D"], lengths: Int[Tensor, "B"], *, sees_padding: bool = False
    ) -> Float[Tensor, "B E"]:
        """See :class:`Evaluator`."""
        return self._network.embed_motions(features, lengths, sees_padding=sees_padding)

    @torch.no_grad()
    def embed_captions(self, captions: Sequence[Caption]) -> Float[Tensor, "B E"]:
        """See :class:`Evaluator`.

        Raises:
            ValueError: If a caption has no ``word/TAG`` tokens.
        """
        sentences = self._words.encode([caption.tokens for caption in captions])
        return self._network.embed_words(sentences.words, sentences.tags, sentences.lengths)


def load_evaluator(folder: str | Path | None = None) -> Evaluator:
    """The evaluator in ``folder``; without one, the evaluator that comes with the package.

    Args:
        folder: What ``controlmm convert-evaluator`` wrote, or a run folder of ``controlmm train evaluator``.

    Raises:
        FileNotFoundError: If there is none; the message says how to get one.
        ValueError: If a file is damaged, or the text encoder is not the one of the training.
    """
    path = shipped_folder(SHIPPED) if folder is None else Path(folder)
    path = next((p for p in (path, path / "best", path / "evaluator" / "best") if _is_network(p)), path)
    if not _is_network(path):
        raise FileNotFoundError(
            f"No evaluator at {path}. Train one with `controlmm train evaluator`, or convert the published "
            "one with `controlmm convert-evaluator`."
        )
    if (path / WORDS_FILE).is_file():
        return PublishedEvaluator(TextMotionMatching.from_pretrained(path), WordVectors.load(path))
    matcher = MotionTextMatcher.from_pretrained(path)
    return LearnedEvaluator(matcher, load_text_encoder(matcher.config.text_encoder))


def _is_network(path: Path) -> bool:
    return (path / CONFIG_FILE).is_file()
