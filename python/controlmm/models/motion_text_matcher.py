"""The in-project evaluator: one space for motions and sentences, learned by contrast.

Source: the idea is TMR's (Petrovich et al., ICCV 2023); the motion network follows the movement and motion
encoders of Guo et al. (CVPR 2022), smaller and independent of padding.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import normalize
from torch.nn.utils.rnn import pack_padded_sequence, pad_packed_sequence

from controlmm.models.rvq_vae import frame_mask
from controlmm.motion.normalizer import Normalizer
from controlmm.nn.checkpoint import PretrainedModel

SNIPPET = 4  # frames of one step of the motion network
_CONTACTS = 4  # channels left out, as in the published evaluator: they are measured, not part of the motion
_RADIUS = 10.0  # of the sphere that embeddings lie on; 1 would give distances with too many leading zeros


@dataclass(frozen=True)
class MatcherConfig:
    """Sizes of the evaluator and the text encoder that it was trained with."""

    feature_dim: int = 263  # D; 251 for KIT-ML
    text_dim: int = 384  # width of the pooled text features
    width: int = 192  # channels of convolutions and, in each direction, of the recurrent layer
    text_width: int = 512  # hidden width of the text network
    embed_dim: int = 128  # E
    dropout: float = 0.2
    text_encoder: dict[str, Any] = field(default_factory=dict)  # `config()` of the text encoder

    def __post_init__(self) -> None:
        if min(self.feature_dim, self.text_dim, self.width, self.text_width, self.embed_dim) < 1:
            raise ValueError(f"Sizes must be positive, got {self}.")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"`dropout` must be in [0, 1), got {self.dropout}.")

    @classmethod
    def small(cls) -> MatcherConfig:
        """The size that ships: 1.15 M parameters."""
        return cls()

    @classmethod
    def paper(cls) -> MatcherConfig:
        """Widths of the published evaluator, for large data sets."""
        return cls(width=512, text_width=1024, embed_dim=512)

    @classmethod
    def tiny(cls) -> MatcherConfig:
        """For tests."""
        return cls(text_dim=64, width=16, text_width=16, embed_dim=8, dropout=0.0)

    def for_data(self, feature_dim: int, text_encoder: dict[str, Any]) -> MatcherConfig:
        """The same sizes for other features and another text encoder (its ``config()``)."""
        return replace(
            self, feature_dim=feature_dim, text_dim=text_encoder["dim"], text_encoder=dict(text_encoder)
        )


class MotionTextMatcher(PretrainedModel):
    """Motions and texts as points on a sphere of radius 10: near if the text describes the motion.

    It takes de-normalised features and carries their statistics with it.
    """

    config_class: ClassVar[type] = MatcherConfig
    config: MatcherConfig

    def __init__(self, config: MatcherConfig, normalizer: Normalizer | None = None) -> None:
        super().__init__(config)
        width, embed = config.width, config.embed_dim
        blank = torch.zeros(config.feature_dim), torch.ones(config.feature_dim)
        self.normalizer = Normalizer(*blank) if normalizer is None else normalizer
        self.dropout = nn.Dropout(config.dropout)
        self.first = nn.Conv1d(config.feature_dim - _CONTACTS, width, SNIPPET, stride=2, padding=1)
        self.second = nn.Conv1d(width, width, SNIPPET, stride=2, padding=1)
        self.recurrent = nn.GRU(width, width, batch_first=True, bidirectional=True)
        self.motion_head = nn.Sequential(
            nn.LayerNorm(2 * width), nn.Dropout(config.dropout), nn.Linear(2 * width, width), nn.GELU(),
            nn.Linear(width, embed),
        )  # fmt: skip
        self.text_head = nn.Sequential(
            nn.Linear(config.text_dim, config.text_width), nn.GELU(), nn.LayerNorm(config.text_width),
            nn.Dropout(config.dropout), nn.Linear(config.text_width, embed),
        )  # fmt: skip

    def embed_motions(
        self, features: Float[Tensor, "B T D"], lengths: Int[Tensor, "B"]
    ) -> Float[Tensor, "B E"]:
        """Embeddings of motions; frames beyond a clip's whole snippets (4 frames) have no influence.

        Args:
            features: De-normalised features; ``T`` at least the longest length.
            lengths: Frames of each clip, 4 or more.
        """
        snippets = lengths // SNIPPET
        frames = int(snippets.max()) * SNIPPET
        x = self.normalizer.normalize(features[:, :frames])[..., :-_CONTACTS]
        x = self._kept(x.transpose(1, 2), snippets * SNIPPET)  # (B, D, T)
        x = self._kept(self.dropout(nn.functional.leaky_relu(self.first(x), 0.2)), snippets * 2)
        x = self.dropout(nn.functional.leaky_relu(self.second(x), 0.2)).transpose(1, 2)  # (B, L, W)
        packed = pack_padded_sequence(x, snippets.cpu(), batch_first=True, enforce_sorted=False)
        states, _ = pad_packed_sequence(self.recurrent(packed)[0], batch_first=True)  # zero in padding
        return self._on_sphere(self.motion_head(states.sum(1) / snippets[:, None]))

    def embed_texts(self, pooled: Float[Tensor, "B C"]) -> Float[Tensor, "B E"]:
        """Embeddings of sentences from their pooled text features."""
        return self._on_sphere(self.text_head(pooled))

    @staticmethod
    def _kept(x: Float[Tensor, "B C T"], lengths: Int[Tensor, "B"]) -> Float[Tensor, "B C T"]:
        return x * frame_mask(lengths, x.shape[2])[:, None]

    @staticmethod
    def _on_sphere(x: Float[Tensor, "B E"]) -> Float[Tensor, "B E"]:
        return _RADIUS * normalize(x, dim=-1)
