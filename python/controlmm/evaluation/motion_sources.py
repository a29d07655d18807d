"""Where evaluated motions come from: recordings, a tokenizer's reconstruction, a pipeline."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.evaluation.random_streams import stream_seed
from controlmm.evaluation.test_set import MAX_FRAMES, Sample
from controlmm.generation.one_thread import one_thread
from controlmm.models.rvq_vae import frame_mask
from controlmm.ops import recover_joints
from controlmm.pipelines.closing import close_clips
from controlmm.pipelines.pipeline import MotionPipeline
from controlmm.text.encoder import TextEncoder, weights_sha256


@dataclass(frozen=True, eq=False)
class Batch:
    """Samples of one repeat with their targets.

    Attributes:
        samples: ``B`` of them.
        real: (B, 196, D) recorded features, de-normalised, zero in padding.
        joints: (B, 196, J, 3) recorded joints in the skeleton's unit.
        mask: (B, 196, J) what is controlled; the targets are ``joints`` there.
        noise_seeds: One a sample, for the generation.
    """

    samples: Sequence[Sample]
    real: Float[Tensor, "B T D"]
    joints: Float[Tensor, "B T J 3"]
    mask: Bool[Tensor, "B T J"]
    noise_seeds: Sequence[int]

    @classmethod
    def of(cls, samples: Sequence[Sample], masks: Sequence[Tensor], *, seed: int, repeat: int) -> Batch:
        """Pad the samples to 196 frames and decode their joints."""
        real = padded_features(samples)
        joints = recover_joints(real, joints=masks[0].shape[1])
        seeds = [stream_seed(seed, repeat, sample.id, "noise") for sample in samples]
        return cls(samples, real, joints, torch.stack(list(masks)), seeds)

    @property
    def lengths(self) -> Int[Tensor, "B"]:
        """Frames of each sample."""
        return torch.tensor([sample.length for sample in self.samples])


@one_thread()
def pooled_texts(encoder: TextEncoder, samples: Sequence[Sample]) -> Float[Tensor, "B E"]:
    """The captions' vectors, each caption encoded by itself, as a call does it.

    In a batch or by more threads a vector differs in its last bits, and editing makes centimetres of them.
    """
    return torch.cat([encoder.encode([sample.caption.text]).pooled for sample in samples])


def padded_features(samples: Sequence[Sample]) -> Float[Tensor, "B 196 D"]:
    """The samples' features with zeros up to 196 frames."""
    padded = torch.zeros(len(samples), MAX_FRAMES, samples[0].features.shape[1])
    for row, sample in zip(padded, samples, strict=True):
        row[: sample.length] = sample.features
    return padded


@dataclass(frozen=True, eq=False)
class Produced:
    """Features of a batch and the seconds that they took.

    ``features`` are (B, 196, D), de-normalised; ``has_padding`` says that a decoder wrote what lies beyond
    the clips, which the published evaluation looks at; ``numbers``, (B,), are what else is worth a column.
    """

    features: Float[Tensor, "B T D"]
    seconds: float
    has_padding: bool
    numbers: Mapping[str, Float[Tensor, "B"]] = field(default_factory=dict)


class MotionSource(Protocol):
    """A row of a table."""

    def describe(self) -> dict[str, Any]:
        """What identifies it, JSON-able: weights, preset."""

    def motions(self, batch: Batch) -> Produced:
        """Motions for the texts, lengths and targets of ``batch``."""


class RealMotion:
    """The recordings themselves."""

    def describe(self) -> dict[str, Any]:
        """See :class:`MotionSource`."""
        return {"source": "real"}

    def motions(self, batch: Batch) -> Produced:
        """See :class:`MotionSource`."""
        return Produced(batch.real, 0.0, has_padding=False)


class Reconstruction:
    """Recordings after the pipeline's tokenizer: what generation can reach at best."""

    def __init__(self, pipeline: MotionPipeline[Any]) -> None:
        self._decoder = pipeline.decoder

    def describe(self) -> dict[str, Any]:
        """See :class:`MotionSource`."""
        return {"source": "reconstruction", "tokenizer": weights_sha256(self._decoder.tokenizer)}

    @torch.no_grad()
    def motions(self, batch: Batch) -> Produced:
        """See :class:`MotionSource`."""
        started = time.perf_counter()
        normalizer, tokenizer = self._decoder.normalizer, self._decoder.tokenizer
        frames = frame_mask(batch.lengths, MAX_FRAMES)
        normalized = normalizer.normalize(batch.real) * frames[..., None]
        latents = tokenizer.quantizer.lookup(tokenizer.encode(normalized, frames))
        features = self._decoder.clip_features(latents, frames)
        return Produced(features, time.perf_counter() - started, has_padding=False)


class Generated:
    """A pipeline's motions under one of its presets."""

    def __init__(self, pipeline: MotionPipeline[Any], preset: Any) -> None:
        self.pipeline, self.preset = pipeline, pipeline.resolve_preset(preset, None)

    def describe(self) -> dict[str, Any]:
        """See :class:`MotionSource`."""
        networks = {name: weights_sha256(network) for name, network in self.pipeline.networks().items()}
        return {"source": self.pipeline.kind, "networks": networks, "preset": asdict(self.preset)}

    @torch.no_grad()
    def motions(self, batch: Batch) -> Produced:
        """See :class:`MotionSource`. Seconds are those of text features, latents and decoding."""
        started = time.perf_counter()
        pipeline, frames = self.pipeline, frame_mask(batch.lengths, MAX_FRAMES)
        latents, numbers = self.latents(batch)
        tokens = MAX_FRAMES // pipeline.decoder.downsample
        latents = torch.nn.functional.pad(latents, (0, 0, 0, tokens - latents.shape[1]))
        features = pipeline.decoder.clip_features(latents, frames)
        if pipeline.closes(self.preset, has_terms=False):
            mask = batch.mask[..., None].expand_as(batch.joints)
            close_clips(features, batch.joints, mask, batch.lengths.tolist(), pipeline.skeleton)
        seconds = time.perf_counter() - started
        # Beyond the clips: what the decoder makes of empty tokens, as in the published evaluation.
        padding = pipeline.decoder.features(latents)
        whole = features.where(frames[..., None], padding)
        return Produced(whole, seconds, has_padding=True, numbers=numbers)

    def latents(self, batch: Batch) -> tuple[Float[Tensor, "B L C"], dict[str, Float[Tensor, "B"]]]:
        """Latents of the motions, and numbers for :class:`Produced`."""
        return self.generated(batch, self.preset), {}

    def generated(self, batch: Batch, preset: Any) -> Float[Tensor, "B L C"]:
        """The pipeline's latents under ``preset``."""
        pipeline = self.pipeline
        return pipeline.generate_latents(
            pooled_texts(pipeline.text_encoder, batch.samples),
            lengths=batch.lengths.tolist(),
            targets=batch.joints,
            mask=batch.mask[..., None].expand_as(batch.joints),
            seeds=batch.noise_seeds,
            preset=preset,
        )
