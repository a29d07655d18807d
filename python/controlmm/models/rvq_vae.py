"""Motion tokenizer: convolutional encoder, residual quantiser, convolutional decoder (MoMask, CVPR 2024)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.models.tokenizer import MotionTokenizer
from controlmm.nn.conv import ConvDecoder, ConvEncoder, DecoderEnds, check_ends
from controlmm.nn.quantizer import ResidualQuantizer


@dataclass(frozen=True)
class RvqVaeConfig:
    """Residual VQ-VAE over HumanML3D features."""

    feature_dim: int = 263  # D; 251 for KIT-ML
    codebook_size: int = 512  # codes in each layer
    code_dim: int = 512  # C
    num_quantizers: int = 6  # layers, the base layer included
    width: int = 512  # channels inside encoder and decoder
    depth: int = 3  # residual blocks at each resolution
    downsample: int = 4  # frames for each token; a power of two
    dropout: float = 0.2
    ema_decay: float = 0.99
    shared_codebook: bool = False
    quantize_dropout: float = 0.2  # share of training batches that use a random number of layers
    sample_temperature: float = 0.5  # of the random code choice in training
    takes_first_rows: bool = (
        False  # fresh and dead codes: first vectors of the batch (published), or random ones
    )
    decoder_ends: DecoderEnds = "zeros"  # published; what the decoder sees beyond a clip, see `ConvDecoder`

    def __post_init__(self) -> None:
        if self.downsample < 2 or self.downsample & (self.downsample - 1):
            raise ValueError(f"`downsample` must be a power of two and at least 2, got {self.downsample}.")
        if min(self.codebook_size, self.code_dim, self.num_quantizers, self.width, self.depth) < 1:
            raise ValueError(f"Sizes must be positive, got {self}.")
        if not 0 <= self.quantize_dropout <= 1 or not 0 <= self.dropout < 1:
            raise ValueError(f"`quantize_dropout` must be in [0, 1] and `dropout` in [0, 1), got {self}.")
        check_ends(self.decoder_ends)

    @classmethod
    def paper(cls) -> RvqVaeConfig:
        """The published size: 19.4 M parameters."""
        return cls()

    @classmethod
    def small(cls) -> RvqVaeConfig:
        """The size that ships: 2.9 M parameters."""
        return cls(code_dim=192, width=192, dropout=0.0, decoder_ends="repeat")

    @classmethod
    def tiny(cls) -> RvqVaeConfig:
        """For tests."""
        return cls(codebook_size=32, code_dim=16, num_quantizers=3, width=16, depth=1, dropout=0.0)

    def for_features(self, feature_dim: int) -> RvqVaeConfig:
        """The same sizes for another feature width."""
        return replace(self, feature_dim=feature_dim)


class RvqVae(MotionTokenizer):
    """Normalised features (B, T, D) <-> tokens, which are ids (B, L, Q) or latents (B, L, C)."""

    config_class: ClassVar[type] = RvqVaeConfig
    training_state: ClassVar[tuple[str, ...]] = ("ema_sum", "ema_count")
    config: RvqVaeConfig
    quantizer: ResidualQuantizer

    def __init__(self, config: RvqVaeConfig) -> None:
        super().__init__(config)
        sizes = {"width": config.width, "depth": config.depth, "downsample": config.downsample}
        self.encoder = ConvEncoder(config.feature_dim, config.code_dim, dropout=config.dropout, **sizes)
        self.decoder = ConvDecoder(
            config.code_dim, config.feature_dim, dropout=config.dropout, ends=config.decoder_ends, **sizes
        )
        self.quantizer = ResidualQuantizer(
            num_quantizers=config.num_quantizers,
            num_codes=config.codebook_size,
            dim=config.code_dim,
            decay=config.ema_decay,
            shared=config.shared_codebook,
            temperature=config.sample_temperature,
            dropout=config.quantize_dropout,
            takes_first_rows=config.takes_first_rows,
        )

    def encode_latents(
        self, features: Float[Tensor, "B T D"], valid: Bool[Tensor, "B T"] | None = None
    ) -> Float[Tensor, "B L C"]:
        """See :meth:`MotionTokenizer.encode_latents`."""
        latents: Tensor = self.encoder(self._encoder_input(features), valid)
        return latents.transpose(1, 2)

    @property
    def base_codes(self) -> Float[Tensor, "K C"]:
        """The codes of layer 0, which the masked transformer predicts."""
        return self.quantizer.book(0).codes


def frame_mask(lengths: Int[Tensor, "B"], frames: int) -> Bool[Tensor, "B T"]:
    """True for the first ``lengths[b]`` of ``frames`` frames."""
    return torch.arange(frames, device=lengths.device) < lengths[:, None]
