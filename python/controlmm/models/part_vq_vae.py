"""Part-based motion tokenizer of TLControl (ECCV 2024): six encoders, six codebooks, one decoder."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from controlmm.models.tokenizer import MotionTokenizer
from controlmm.motion.body_parts import body_parts
from controlmm.motion.skeleton import skeleton_of_width
from controlmm.nn.conv import ConvDecoder, ConvEncoder, DecoderEnds, check_ends
from controlmm.nn.part_quantizer import PartQuantizer

_PUBLISHED_TOKENS = 49  # of the published training, which pads every clip to 196 frames
_LEAST_NORM = 1e-8  # keeps a latent of zeros finite; the published code divides by zero


@dataclass(frozen=True)
class PartVqVaeConfig:
    """Part-based VQ-VAE over HumanML3D features."""

    feature_dim: int = 263  # D; 251 for KIT-ML
    codebook_size: int = 128  # codes of each part; the paper's supplement says 126, the released weights 128
    code_dim: int = 128  # channels of one part's code
    width: int = 512  # channels inside the decoder
    encoder_width: int = 512  # channels inside each encoder
    depth: int = 3  # residual blocks at each resolution
    downsample: int = 4  # frames for each token; a power of two
    ema_decay: float = 0.99
    # "step": every token's latent is scaled on its own. "clip" (published): one scale for a part's whole
    # clip, so codes depend on the padded length; such a model only works at the length it was trained at.
    latent_norm: Literal["step", "clip"] = "step"
    is_split: bool = True  # False: the paper's ablation, one encoder and codebook for the whole body
    decoder_ends: DecoderEnds = "zeros"  # published; what the decoder sees beyond a clip, see `ConvDecoder`

    def __post_init__(self) -> None:
        if self.downsample < 2 or self.downsample & (self.downsample - 1):
            raise ValueError(f"`downsample` must be a power of two and at least 2, got {self.downsample}.")
        if min(self.codebook_size, self.code_dim, self.width, self.encoder_width, self.depth) < 1:
            raise ValueError(f"Sizes must be positive, got {self}.")
        if self.latent_norm not in ("step", "clip"):
            raise ValueError(f"`latent_norm` must be 'step' or 'clip', got {self.latent_norm!r}.")
        check_ends(self.decoder_ends)

    @classmethod
    def paper(cls) -> PartVqVaeConfig:
        """The published network: 62.2 M parameters, 10.2 M of them in the decoder."""
        return cls(latent_norm="clip")

    @classmethod
    def small(cls) -> PartVqVaeConfig:
        """The size that ships: 3.7 M parameters, 1.6 M of them in the decoder."""
        return cls(codebook_size=256, code_dim=64, width=192, encoder_width=96, decoder_ends="repeat")

    @classmethod
    def tiny(cls) -> PartVqVaeConfig:
        """For tests."""
        return cls(codebook_size=16, code_dim=4, width=16, encoder_width=8, depth=1)

    def for_features(self, feature_dim: int) -> PartVqVaeConfig:
        """The same sizes for another feature width."""
        return replace(self, feature_dim=feature_dim)

    def unsplit(self) -> PartVqVaeConfig:
        """The ablation: one encoder and codebook, same latent size, as many codes as all parts together."""
        parts = self.num_parts
        return replace(
            self,
            is_split=False,
            codebook_size=parts * self.codebook_size,
            code_dim=parts * self.code_dim,
            encoder_width=self.width,
        )

    @property
    def num_parts(self) -> int:
        """Codes of one token."""
        return len(body_parts(skeleton_of_width(self.feature_dim))) if self.is_split else 1

    @property
    def published_unit(self) -> float:
        """What a published latent is in these: there a part has norm 1 over a clip of 49 tokens."""
        return 1.0 if self.latent_norm == "clip" else math.sqrt(self.code_dim * _PUBLISHED_TOKENS)

    @property
    def latent_dim(self) -> int:
        """Channels of one token's latent, all parts together."""
        return self.num_parts * self.code_dim


class PartVqVae(MotionTokenizer):
    """Normalised features (B, T, D) <-> tokens: ids (B, L, Q) or latents (B, L, C), ``C = Q code_dim``."""

    config_class: ClassVar[type] = PartVqVaeConfig
    training_state: ClassVar[tuple[str, ...]] = ("ema_sum", "ema_count")
    config: PartVqVaeConfig
    quantizer: PartQuantizer

    def __init__(self, config: PartVqVaeConfig) -> None:
        super().__init__(config)
        self._channels = _part_channels(config)
        sizes = {"depth": config.depth, "downsample": config.downsample}
        self.encoders = nn.ModuleList(
            ConvEncoder(len(channels), config.code_dim, width=config.encoder_width, dropout=0.0, **sizes)
            for channels in self._channels
        )
        self.decoder = ConvDecoder(
            config.latent_dim,
            config.feature_dim,
            width=config.width,
            dropout=0.0,
            ends=config.decoder_ends,
            **sizes,
        )
        self.quantizer = PartQuantizer(
            parts=config.num_parts,
            num_codes=config.codebook_size,
            dim=config.code_dim,
            decay=config.ema_decay,
        )

    def encode_latents(
        self, features: Float[Tensor, "B T D"], valid: Bool[Tensor, "B T"] | None = None
    ) -> Float[Tensor, "B L C"]:
        """Scaled latents of all parts side by side; see :meth:`MotionTokenizer.encode_latents`."""
        channel_major = self._encoder_input(features)
        parts = [
            self._scaled(encoder(channel_major[:, list(channels)], valid).transpose(1, 2))
            for encoder, channels in zip(self.encoders, self._channels, strict=True)
        ]
        return torch.cat(parts, dim=-1)

    def _scaled(self, latents: Float[Tensor, "B L C"]) -> Float[Tensor, "B L C"]:
        """Latents of one part: a norm of 1 over the whole clip, or a root mean square of 1 in every token."""
        axes, norm = ((1, 2), 1.0) if self.config.latent_norm == "clip" else ((2,), latents.shape[2])
        squares = latents.float().square().sum(axes, keepdim=True)
        return latents * (math.sqrt(norm) * torch.rsqrt(squares + _LEAST_NORM))


def _part_channels(config: PartVqVaeConfig) -> tuple[tuple[int, ...], ...]:
    if not config.is_split:
        return (tuple(range(config.feature_dim)),)
    return tuple(part.channels for part in body_parts(skeleton_of_width(config.feature_dim)))
