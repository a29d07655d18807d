"""From code-space latents to joints in metres: the path that every objective differentiates through."""

from __future__ import annotations

import threading
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from controlmm.generation.clip_groups import EndToEnd, clips_end_to_end
from controlmm.generation.code_spread import CodeSpread
from controlmm.generation.frozen_decoder import FrozenDecoder
from controlmm.generation.joint_progress import Progress
from controlmm.generation.one_thread import one_thread
from controlmm.generation.sensitivity import WINDOW, Sensitivity, measure_sensitivity
from controlmm.generation.side_by_side import side_by_side
from controlmm.models.tokenizer import MotionTokenizer
from controlmm.motion.normalizer import Normalizer
from controlmm.nn.quantizer import ResidualQuantizer
from controlmm.ops import recover_joints

_SEQUENCES, _SEED = 6, 1  # of random codes
_REMEMBERED = 200_000_000  # bytes of channel products: four choices of six joints
# Shares of a batch fill the caches at once. They need the same, so one makes it and the others wait; none may
# clear what another is about to return.
_FILLING = threading.RLock()


class MotionDecoder(nn.Module):
    """The tokenizer's decoder, the feature statistics and the kinematics in one, weights frozen.

    Latents are sums of code vectors, (B, L, C). ``frames`` (B, T) marks the frames of each clip, so that a
    clip's motion does not depend on the padding of its batch.
    """

    def __init__(self, tokenizer: MotionTokenizer, normalizer: Normalizer) -> None:
        super().__init__()
        self.tokenizer = tokenizer.eval().requires_grad_(False)
        self.normalizer = normalizer
        self._packed_version: tuple[int, ...] = ()
        self._layers: tuple[nn.Module, list[nn.Module]] | None = None  # of the decoder, those with parameters
        self._frozen: dict[torch.dtype, FrozenDecoder] = {}
        self._spread: tuple[tuple[int, ...], CodeSpread] | None = None
        self._sensitivities: dict[int, Sensitivity] = {}  # of each channel
        self._grams: dict[tuple[int, ...], Tensor] = {}

    def frozen(self, dtype: torch.dtype = torch.float32) -> FrozenDecoder:
        """The decoder's convolutions packed for editing; packed again when its weights have changed."""
        weights = self.tokenizer.decoder
        version = self._version_of(weights)
        with _FILLING:
            if self._packed_version != version:
                self._packed_version = version
                self._frozen.clear()
                self._sensitivities.clear()
                self._grams.clear()
            if dtype not in self._frozen:
                self._frozen[dtype] = FrozenDecoder(weights, dtype=dtype)
            return self._frozen[dtype]

    def _version_of(self, weights: nn.Module) -> tuple[int, ...]:
        """What changes with any weight; asked so often that a walk through the modules would show."""
        if self._layers is None or self._layers[0] is not weights:
            self._layers = weights, [layer for layer in weights.modules() if layer._parameters]
        parameters = (p for layer in self._layers[1] for p in layer._parameters.values() if p is not None)
        return tuple(x for p in parameters for x in (p.data_ptr(), p._version))

    def channel_gram(self, channels: tuple[int, ...], tokens: int) -> Float[Tensor, "D S D S"]:
        """Products of the rows of the decoder's Jacobian, in the unit of :meth:`spread`; see ``sensitivity``.

        Of the frames of ``tokens`` or more.

        Each channel is measured once (a fraction of a second for a joint), products are remembered for some
        choices. A shorter clip takes a part of what a longer one had.
        """
        frames = tokens * self.downsample
        with _FILLING:
            frozen, spread = self.frozen(), self.spread()
            unknown = [channel for channel in channels if channel not in self._sensitivities]
            for channel in unknown:  # one by one: it is the same then whatever is measured beside it
                self._sensitivities[channel] = measure_sensitivity(
                    frozen, self.typical_latents(), [channel], downsample=self.downsample, spread=spread
                )
            if channels not in self._grams or self._grams[channels].shape[1] < frames:
                self._grams.pop(channels, None)
                own = Sensitivity.joined([self._sensitivities[channel] for channel in channels])
                self._remember(channels, own.gram(tokens))
            return self._grams[channels]

    def _remember(self, channels: tuple[int, ...], gram: Float[Tensor, "D T D T"]) -> None:
        """Keep products, and forget the oldest ones that there is no more room for."""
        self._grams[channels] = gram
        while len(self._grams) > 1 and sum(known.nbytes for known in self._grams.values()) > _REMEMBERED:
            self._grams.pop(next(iter(self._grams)))

    def spread(self) -> CodeSpread:
        """The unit of steps in latent space, of a residual tokenizer."""
        quantizer = self.tokenizer.quantizer
        assert isinstance(quantizer, ResidualQuantizer)  # only its sums of codes have one spread
        books = [quantizer.book(layer).codes for layer in range(self.tokenizer.config.num_quantizers)]
        version = tuple(x for codes in books for x in (codes.data_ptr(), codes._version))
        with _FILLING:
            if self._spread is None or self._spread[0] != version:
                with one_thread():
                    self._spread = version, CodeSpread.of_codebooks(books)
                self._sensitivities.clear()
                self._grams.clear()
            return self._spread[1]

    @one_thread()
    def code_deviation(self) -> float:
        """Standard deviation of the base codes' entries: the unit of rates."""
        return self.tokenizer.base_codes.std().item()

    def typical_latents(self) -> Float[Tensor, "S W C"]:
        """A few sequences of random codes, always the same."""
        generator = torch.Generator().manual_seed(_SEED)
        sizes = (_SEQUENCES, WINDOW, self.tokenizer.config.num_quantizers)
        ids = torch.randint(len(self.tokenizer.base_codes), sizes, generator=generator)
        return self.tokenizer.quantizer.lookup(ids)

    @property
    def downsample(self) -> int:
        """Frames for each token."""
        return self.tokenizer.downsample

    def features(
        self, latents: Float[Tensor, "B L C"], frames: Bool[Tensor, "B T"] | None = None
    ) -> Float[Tensor, "B T D"]:
        """De-normalised features."""
        return self.normalizer.denormalize(self.tokenizer.decode(latents, frames).float())

    @torch.no_grad()
    def clip_features(
        self, latents: Float[Tensor, "B L C"], frames: Bool[Tensor, "B T"] | None = None
    ) -> Float[Tensor, "B T D"]:
        """De-normalised features, each clip decoded at its own length: the same, to the bit, in any batch.

        On the CPU, clips side by side, and without gradients; :meth:`features` has neither limit.
        """
        frozen, step = self.frozen(), self.downsample
        if frames is None:
            frames = torch.ones(len(latents), latents.shape[1] * step, dtype=torch.bool)
        channels = range(len(self.normalizer.mean))
        normalized = torch.zeros(*frames.shape, len(channels))
        tokens = frames[:, ::step]
        latents = latents[:, : tokens.shape[1]].flatten(0, 1)

        def decode(group: EndToEnd, _progress: Progress | None) -> None:
            clips = latents[None, group.tokens]
            decoded, _ = frozen.forward(clips, channels, group.lengths, is_looked_at_again=True)
            normalized.flatten(0, 1)[group.frames] = decoded[0]

        groups = clips_end_to_end(tokens.sum(1).tolist(), padded=tokens.shape[1], step=step)
        side_by_side([partial(decode, group) for group in groups])
        return self.normalizer.denormalize(normalized)

    def forward(
        self, latents: Float[Tensor, "B L C"], frames: Bool[Tensor, "B T"] | None = None
    ) -> Float[Tensor, "B T J 3"]:
        """Global joint positions in metres."""
        return recover_joints(self.features(latents, frames), joints=self.normalizer.skeleton.num_joints)

    def base_latents(self, ids: Int[Tensor, "B L"], valid: Bool[Tensor, "B L"]) -> Float[Tensor, "B L C"]:
        """Base codes of partly masked tokens: the mean code where the id is no code, zero in padding."""
        codes = self.tokenizer.base_codes
        is_code = (ids >= 0) & (ids < len(codes))
        looked_up = codes[ids.clamp(0, len(codes) - 1)]
        latents = looked_up.where(is_code[..., None], codes.mean(0))
        return latents * valid[..., None]
