"""Timelines in tracks: entries are made apart, then their parts are put onto one body."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from controlmm.controls import TimelineEntry
from controlmm.generation.composition import Tracks, composed
from controlmm.generation.noise import clip_seeds
from controlmm.generation.relative_term import RelativeTerm
from controlmm.generation.solvers import Progress
from controlmm.motion.ground import grounded
from controlmm.motion.motion import Motion
from controlmm.ops import recover_joints
from controlmm.pipelines.checks import MIN_FRAMES
from controlmm.pipelines.closing import close_clips
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.reach import check_reach
from controlmm.pipelines.scene import Scene
from controlmm.pipelines.source_motion import SourceMotion

if TYPE_CHECKING:
    from controlmm.pipelines.pipeline import MotionPipeline

Plan = TypeVar("Plan")  # a pipeline's kind of preset

_ENTRY_SEED = 0x632BE59BD9B4E019  # odd 64-bit constant: each entry draws its own noise


def run_tracks(
    pipeline: MotionPipeline[Plan],
    scene: Scene,
    entries: Sequence[TimelineEntry],
    *,
    samples: int,
    preset: Plan,
    seed: int,
    progress: Progress | None,
) -> GenerationResult:
    """See :meth:`MotionPipeline.timeline`, the method ``tracks``."""
    started = time.perf_counter()
    skeleton, frames = pipeline.skeleton, scene.frames
    tracks = Tracks.of(entries, skeleton)
    motions, starts = _motions(pipeline, scene, tracks, entries, clip_seeds(seed, samples), preset, progress)
    sources = [
        _source(composed(tracks, [entry[sample] for entry in motions], starts), pipeline)
        for sample in range(samples)
    ]
    padded = pipeline.padded_frames(frames)
    features = torch.stack([_padded(source.features.float(), padded) for source in sources])
    tokenizer = pipeline.decoder.tokenizer
    ids = tokenizer.encode(pipeline.decoder.normalizer.normalize(features))
    wanted = torch.stack([source.joints for source in sources])
    controlled = scene.canonical.mask.any(-1)  # a control overrules its joint
    term = RelativeTerm.towards(wanted, tracks.known_joints & ~controlled, padded=padded, skeleton=skeleton)
    missing = (0, 0, 0, 0, 0, padded - frames)
    latents = pipeline.refined_latents(
        tokenizer.quantizer.lookup(ids),
        torch.ones(ids.shape[:2], dtype=torch.bool),
        nn.functional.pad(scene.canonical.targets, missing).expand(samples, -1, -1, -1),
        nn.functional.pad(scene.canonical.mask, missing).expand(samples, -1, -1, -1),
        preset,
        terms=(term, *scene.terms(samples, padded=padded, skeleton=skeleton)),
        progress=progress,
    )
    decoded = pipeline.decoder.clip_features(latents)[:, :frames]
    if pipeline.closes(preset, has_terms=bool(scene.obstacles)):
        reached = check_reach(scene.controls, skeleton, is_strict=False)
        within = scene.canonical.mask & reached[:, None, None]
        targets, mask = (x.expand(samples, -1, -1, -1) for x in (scene.canonical.targets, within))
        close_clips(decoded, targets, mask, [frames] * samples, skeleton)
    held = term.errors(recover_joints(decoded, joints=skeleton.num_joints))
    result = scene.result(decoded, latents, seconds_taken=time.perf_counter() - started)
    return dataclasses.replace(result, control_error=torch.maximum(result.control_error, held))


def _motions(
    pipeline: MotionPipeline[Plan],
    scene: Scene,
    tracks: Tracks,
    entries: Sequence[TimelineEntry],
    seeds: Sequence[int],
    preset: Plan,
    progress: Progress | None,
) -> tuple[list[Float[Tensor, "S T D"]], list[int]]:
    """Features of every entry's motion for every sample, and where each begins; all in one batch.

    Motions that begin with the timeline see the controls of the joints that they move: they stand where the
    whole does.
    """
    spans = [tracks.span(index) for index in range(len(entries))]
    lengths = [max(MIN_FRAMES, end - start) for start, end in spans]
    longest, count, samples = max(lengths), len(entries), len(seeds)
    targets = torch.zeros(count, longest, tracks.skeleton.num_joints, 3)
    mask = torch.zeros(targets.shape, dtype=torch.bool)
    for index, (start, end) in enumerate(spans):
        if start == 0 and end > 0:
            shown = scene.canonical.mask[:end] & tracks.joints_of(index)[:end, :, None]
            targets[index, :end], mask[index, :end] = scene.canonical.targets[:end] * shown, shown
    text = pipeline.text_encoder.encode([entry.prompt for entry in entries]).pooled
    latents = pipeline.generate_latents(
        text.repeat_interleave(samples, dim=0),
        lengths=[length for length in lengths for _ in seeds],
        targets=targets.repeat_interleave(samples, dim=0),
        mask=mask.repeat_interleave(samples, dim=0),
        seeds=[(seed + index * _ENTRY_SEED) % 2**63 for index in range(count) for seed in seeds],
        preset=preset,
        progress=progress,
    )
    features = []
    for index, length in enumerate(lengths):
        tokens = pipeline.padded_frames(length) // pipeline.decoder.downsample
        clips = latents[index * samples : (index + 1) * samples, :tokens]
        own = pipeline.decoder.clip_features(clips)[:, :length]
        if pipeline.closes(preset, has_terms=False):  # parts of bodies with whole bones fit together
            wanted, shown = (x[index, :length].expand(samples, -1, -1, -1) for x in (targets, mask))
            close_clips(own, wanted, shown, [length] * samples, pipeline.skeleton)
        features.append(own if mask[index, ..., 1].any() else grounded(own))
    return features, [start for start, _ in spans]


def _source(features: Float[Tensor, "T D"], pipeline: MotionPipeline[Plan]) -> SourceMotion:
    """The composed body with all its channels made anew from its joints."""
    skeleton = pipeline.skeleton
    joints = recover_joints(features[None], joints=skeleton.num_joints)[0]
    return SourceMotion.of(Motion(joints, skeleton=skeleton), skeleton=skeleton, max_frames=pipeline.longest)


def _padded(features: Float[Tensor, "T D"], frames: int) -> Float[Tensor, "T D"]:
    return torch.cat([features, features[-1:].expand(frames - len(features), -1)])
