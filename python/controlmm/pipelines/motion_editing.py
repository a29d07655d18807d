"""Editing a motion that exists: some of it stays, a prompt decides the rest."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from controlmm.generation.inpainting import RESIDUAL_GUIDANCE, inpaint_tokens, vary_tokens
from controlmm.generation.latent_editing import edit_latents
from controlmm.generation.masked_decoding import DecodingRequest, fill_residual_layers
from controlmm.generation.noise import ClipNoise, clip_seeds
from controlmm.generation.objective import ControlObjective, control_error
from controlmm.generation.solvers import Progress
from controlmm.motion.motion import Motion
from controlmm.ops import recover_joints
from controlmm.pipelines.checks import check_sampling
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.pipeline import MAX_FRAMES
from controlmm.pipelines.presets import Preset
from controlmm.pipelines.source_motion import Interval, SourceMotion, kept_coordinates, kept_frames
from controlmm.text import check_prompt

if TYPE_CHECKING:
    from controlmm.pipelines.controlmm import ControlMM


def run_edit(
    pipeline: ControlMM,
    motion: Motion,
    prompt: str,
    *,
    keep: Sequence[Interval],
    keep_parts: Sequence[str],
    exact: bool,
    samples: int,
    preset: Preset,
    seed: int,
    progress: Progress | None,
) -> GenerationResult:
    """See :meth:`ControlMM.edit`."""
    started = time.perf_counter()
    prompt = check_prompt(prompt)
    check_sampling(samples=samples, seed=seed)
    skeleton = pipeline.skeleton
    source = SourceMotion.of(motion, skeleton=skeleton, max_frames=MAX_FRAMES)
    kept = kept_coordinates(source, keep, keep_parts, skeleton)
    frames = source.num_frames
    mask = kept[None, ..., None].expand(samples, -1, -1, 3)
    targets = source.joints.expand(samples, -1, -1, -1) * mask
    text = pipeline.text_encoder.encode([prompt]).pooled.expand(samples, -1)
    seeds = clip_seeds(seed, samples)
    if keep_parts:
        latents = pipeline.generate_latents(
            text,
            lengths=[frames] * samples,
            targets=targets,
            mask=mask,
            seeds=seeds,
            preset=preset,
            progress=progress,
        )
    else:
        whole = kept_frames(frames, keep, skeleton.fps)
        request = _request(pipeline, text, frames, seeds, preset, progress)
        latents = _redrawn(pipeline, source, request, whole)
        if exact and keep:
            pinning = _pinning(pipeline, targets, mask)
            all_tokens = torch.ones(*request.valid.shape, 1)
            latents = edit_latents(pinning, latents, all_tokens, preset.budget, progress=progress).latents
    features = pipeline.decoder.features(latents)[:, :frames]
    joints = recover_joints(features, joints=skeleton.num_joints)
    error = control_error(joints, targets, mask)
    # Whole poses are not targets in pictures: thousands of points would hide the figure.
    extra = {"targets": source.placed(source.joints), "mask": mask[0]} if keep_parts and not keep else {}
    motions = tuple(
        Motion(
            source.placed(clip), features=own.contiguous(), skeleton=skeleton, text=prompt, extra=dict(extra)
        )
        for clip, own in zip(joints, features, strict=True)
    )
    return GenerationResult(motions, error, torch.zeros_like(error), latents, time.perf_counter() - started)


def _request(
    pipeline: ControlMM,
    text: Float[Tensor, "B E"],
    frames: int,
    seeds: Sequence[int],
    preset: Preset,
    progress: Progress | None,
) -> DecodingRequest:
    tokens = pipeline.padded_frames(frames) // pipeline.decoder.downsample
    return DecodingRequest(
        text,
        torch.ones(len(text), tokens, dtype=torch.bool),
        ClipNoise(seeds),
        steps=preset.steps,
        guidance_scale=preset.guidance_scale,
        rules=preset.rules,
        progress=progress,
    )


def _redrawn(
    pipeline: ControlMM, source: SourceMotion, request: DecodingRequest, kept: Bool[Tensor, "T"]
) -> Float[Tensor, "B L C"]:
    """Latents with the source's tokens where all their frames are kept; the others follow the text."""
    tokenizer, step = pipeline.decoder.tokenizer, pipeline.decoder.downsample
    padded = request.valid.shape[1] * step
    is_kept = nn.functional.pad(kept, (0, padded - len(kept)), value=True).unflatten(0, (-1, step)).all(1)
    ids = _tokens(pipeline, source, padded).expand(len(request.text), -1, -1)
    editable = ~is_kept.expand(len(ids), -1)
    if editable.all():
        base_ids = vary_tokens(pipeline.transformer, request, ids[..., 0])
    else:
        base_ids = inpaint_tokens(pipeline.transformer, request, ids[..., 0], editable)
    filled = fill_residual_layers(pipeline.residual, base_ids, request, guidance_scale=RESIDUAL_GUIDANCE)
    is_same = (base_ids == ids[..., 0])[..., None]
    return tokenizer.quantizer.lookup(torch.where(is_same, ids, filled))


def _tokens(pipeline: ControlMM, source: SourceMotion, padded: int) -> Int[Tensor, "1 L Q"]:
    features = source.features.float()
    longer = torch.cat([features, features[-1:].expand(padded - len(features), -1)])
    ids: Tensor = pipeline.decoder.tokenizer.encode(pipeline.decoder.normalizer.normalize(longer)[None])
    return ids


def _pinning(pipeline: ControlMM, targets: Tensor, mask: Tensor) -> ControlObjective:
    missing = pipeline.padded_frames(targets.shape[1]) - targets.shape[1]
    targets, mask = (nn.functional.pad(dense, (0, 0, 0, 0, 0, missing)) for dense in (targets, mask))
    return ControlObjective(pipeline.decoder, targets, mask, torch.ones(mask.shape[:2], dtype=torch.bool))
