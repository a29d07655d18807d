"""The published evaluator: text and motion encoders that were trained to match (HumanML3D, KIT-ML).

Source: Guo et al., "Generating Diverse and Natural 3D Human Motions from Text", CVPR 2022. Module names are
those of its checkpoints.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.utils.rnn import pack_padded_sequence

from controlmm.models.rvq_vae import frame_mask
from controlmm.motion.normalizer import Normalizer
from controlmm.nn.checkpoint import PretrainedModel

WORD_DIM, TAG_COUNT = 300, 15  # GloVe vectors, classes of words
_SNIPPET = 4  # frames
_CONTACTS = 4  # channels that the evaluator does not see
_SLOPE, _DROPOUT = 0.2, 0.2


@dataclass(frozen=True)
class MatchingConfig:
    """Sizes of the published networks; only the feature width differs between its two data sets."""

    feature_dim: int = 263  # D; 251 for KIT-ML
    width: int = 512  # of snippets and embeddings
    motion_hidden: int = 1024  # of the motion GRU, in each direction
    text_hidden: int = 512  # of the text GRU

    def __post_init__(self) -> None:
        if min(self.feature_dim - _CONTACTS, self.width, self.motion_hidden, self.text_hidden) < 1:
            raise ValueError(f"Sizes must be positive, got {self}.")

    @classmethod
    def tiny(cls) -> MatchingConfig:
        """For tests."""
        return cls(width=8, motion_hidden=8, text_hidden=8)


class MovementEncoder(nn.Module):
    """Features without contacts (B, T, D-4), normalised -> snippets of four frames (B, T/4, W)."""

    def __init__(self, config: MatchingConfig) -> None:
        super().__init__()
        self.main = nn.Sequential(
            nn.Conv1d(config.feature_dim - _CONTACTS, config.width, 4, stride=2, padding=1),
            nn.Dropout(_DROPOUT),
            nn.LeakyReLU(_SLOPE),
            nn.Conv1d(config.width, config.width, 4, stride=2, padding=1),
            nn.Dropout(_DROPOUT),
            nn.LeakyReLU(_SLOPE),
        )
        self.out_net = nn.Linear(config.width, config.width)

    def forward(self, features: Float[Tensor, "B T C"]) -> Float[Tensor, "B L W"]:
        """Snippet ``t`` sees frames ``4 t - 3`` to ``4 t + 6``."""
        snippets: Tensor = self.out_net(self.main(features.transpose(1, 2)).transpose(1, 2))
        return snippets


class SequenceEncoder(nn.Module):
    """A bidirectional GRU with learned initial states; its two final states become one embedding."""

    def __init__(self, input_dim: int, hidden: int, *, inner: int, output_dim: int) -> None:
        super().__init__()
        self.hidden = nn.Parameter(torch.zeros(2, 1, hidden))
        self.input_emb = nn.Linear(input_dim, inner)
        self.gru = nn.GRU(inner, hidden, batch_first=True, bidirectional=True)
        self.output_net = nn.Sequential(
            nn.Linear(2 * hidden, hidden),
            nn.LayerNorm(hidden),
            nn.LeakyReLU(_SLOPE),
            nn.Linear(hidden, output_dim),
        )

    def forward(self, sequence: Float[Tensor, "B L C"], lengths: Int[Tensor, "B"]) -> Float[Tensor, "B E"]:
        """Rows in the order of the input: the published code leaves them sorted by length."""
        packed = pack_padded_sequence(
            self.input_emb(sequence), lengths.cpu(), batch_first=True, enforce_sorted=False
        )
        _, last = self.gru(packed, self.hidden.expand(-1, len(sequence), -1).contiguous())
        embedding: Tensor = self.output_net(torch.cat([last[0], last[1]], dim=-1))
        return embedding


class WordEncoder(SequenceEncoder):
    """Word vectors and word classes -> one embedding."""

    def __init__(self, config: MatchingConfig) -> None:
        super().__init__(WORD_DIM, config.text_hidden, inner=config.width, output_dim=config.width)
        self.pos_emb = nn.Linear(TAG_COUNT, WORD_DIM)


class TextMotionMatching(PretrainedModel):
    """The three published networks and the statistics that they were trained with."""

    config_class: ClassVar[type] = MatchingConfig
    config: MatchingConfig

    def __init__(self, config: MatchingConfig, normalizer: Normalizer | None = None) -> None:
        super().__init__(config)
        blank = torch.zeros(config.feature_dim), torch.ones(config.feature_dim)
        self.normalizer = Normalizer(*blank) if normalizer is None else normalizer
        self.movement_encoder = MovementEncoder(config)
        self.motion_encoder = SequenceEncoder(
            config.width, config.motion_hidden, inner=config.motion_hidden, output_dim=config.width
        )
        self.text_encoder = WordEncoder(config)

    def embed_motions(
        self, features: Float[Tensor, "B T D"], lengths: Int[Tensor, "B"], *, sees_padding: bool = False
    ) -> Float[Tensor, "B E"]:
        """Embeddings of motions.

        Args:
            features: De-normalised features.
            lengths: Frames of each clip.
            sees_padding: The last snippet of a clip looks three frames beyond its end. Recorded clips have
                zeros there (after normalisation), as here by default. The published evaluation leaves there
                what the decoder wrote into the padding of generated clips; ``True`` does so too.
        """
        normalized = self.normalizer.normalize(features)
        if not sees_padding:
            normalized = normalized * frame_mask(lengths, features.shape[1])[..., None]
        snippets = self.movement_encoder(normalized[..., :-_CONTACTS])
        embedding: Tensor = self.motion_encoder(snippets, lengths // _SNIPPET)
        return embedding

    def embed_words(
        self,
        words: Float[Tensor, "B S 300"],
        tags: Float[Tensor, "B S 15"],
        lengths: Int[Tensor, "B"],
    ) -> Float[Tensor, "B E"]:
        """Embeddings of sentences, see :class:`controlmm.text.word_vectors.WordVectors`."""
        embedding: Tensor = self.text_encoder(words + self.text_encoder.pos_emb(tags), lengths)
        return embedding
