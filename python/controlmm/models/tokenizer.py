"""What motion tokenizers share: encoder, quantiser, decoder in front of normalised features."""

from __future__ import annotations

from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.nn.checkpoint import PretrainedModel
from controlmm.nn.conv import ConvDecoder
from controlmm.nn.quantizer import Quantized, Quantizer


class MotionTokenizer(PretrainedModel):
    """Normalised features (B, T, D) <-> tokens, which are ids (B, L, Q) or latents (B, L, C).

    A subclass sets ``decoder`` and ``quantizer`` and defines :meth:`encode_latents`.
    """

    decoder: ConvDecoder
    quantizer: Quantizer

    @property
    def downsample(self) -> int:
        """Frames for each token."""
        frames: int = self.config.downsample
        return frames

    def encode_latents(
        self, features: Float[Tensor, "B T D"], valid: Bool[Tensor, "B T"] | None = None
    ) -> Float[Tensor, "B L C"]:
        """Encoder output before quantisation.

        Args:
            features: Normalised; ``T`` a multiple of ``downsample``.
            valid: Frames that belong to each clip (a prefix, a multiple of ``downsample``); ``None`` means
                all. With it, a clip's result does not depend on the padding.

        Raises:
            ValueError: If ``T`` is no multiple of ``downsample``.
        """
        raise NotImplementedError

    @property
    def base_codes(self) -> Float[Tensor, "K C"]:
        """The codes of layer 0, which the masked transformer predicts; only a residual tokenizer has them."""
        raise NotImplementedError(f"{type(self).__name__} has no base layer.")

    def forward(
        self, features: Float[Tensor, "B T D"], valid: Bool[Tensor, "B T"] | None = None
    ) -> tuple[Float[Tensor, "B T D"], Quantized]:
        """Reconstruction and quantisation of ``features``; see :meth:`encode_latents` for the arguments."""
        quantized = self.quantizer(self.encode_latents(features, valid), self._token_mask(valid))
        return self.decode(quantized.latents, valid), quantized

    def encode(
        self, features: Float[Tensor, "B T D"], valid: Bool[Tensor, "B T"] | None = None
    ) -> Int[Tensor, "B L Q"]:
        """Token ids; -1 in padding. Use in evaluation mode: training mode changes codebooks and may draw."""
        quantized: Quantized = self.quantizer(self.encode_latents(features, valid), self._token_mask(valid))
        return quantized.ids

    def decode(
        self, latents: Float[Tensor, "B L C"], valid: Bool[Tensor, "B T"] | None = None
    ) -> Float[Tensor, "B T D"]:
        """Normalised features of latents."""
        return self.decode_channels(latents, valid).transpose(1, 2)

    def decode_channels(
        self, latents: Float[Tensor, "B L C"], valid: Bool[Tensor, "B T"] | None = None
    ) -> Float[Tensor, "B D T"]:
        """Like :meth:`decode` but channel-major, as the last convolution emits it."""
        decoded: Tensor = self.decoder(latents.transpose(1, 2), valid)
        return decoded

    def decode_ids(
        self, ids: Int[Tensor, "B L Q"], valid: Bool[Tensor, "B T"] | None = None
    ) -> Float[Tensor, "B T D"]:
        """Normalised features of token ids; -1 adds nothing."""
        return self.decode(self.quantizer.lookup(ids), valid)

    def _encoder_input(self, features: Float[Tensor, "B T D"]) -> Float[Tensor, "B D T"]:
        if features.shape[1] % self.downsample:
            raise ValueError(
                f"`features` must have a multiple of {self.downsample} frames, got {features.shape[1]}."
            )
        return features.transpose(1, 2)

    def _token_mask(self, valid: Tensor | None) -> Tensor | None:
        return None if valid is None else valid[:, :: self.downsample]
