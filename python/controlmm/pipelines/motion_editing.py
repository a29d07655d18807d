"""Editing a motion that exists: some of it stays, a prompt and controls decide the rest."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from controlmm.controls import Avoid, Control, Objective, Obstacle, penetration
from controlmm.generation.decoding_request import DecodingRequest
from controlmm.generation.kept_tokens import KeptTokens
from controlmm.generation.latent_editing import edit_latents
from controlmm.generation.masked_decoding import fill_residual_layers
from controlmm.generation.noise import ClipNoise, clip_seeds
from controlmm.generation.objective import ControlObjective, control_error
from controlmm.generation.shares import in_shares
from controlmm.generation.solvers import Progress
from controlmm.generation.terms import JointTerm
from controlmm.generation.variation import VARIATION_STEPS, vary_tokens
from controlmm.motion.features import bone_lengths
from controlmm.motion.motion import Motion
from controlmm.ops import recover_joints
from controlmm.pipelines.checks import check_sampling
from controlmm.pipelines.clip_batch import share_count
from controlmm.pipelines.closing import close_clips
from controlmm.pipelines.edit_scene import EditScene, held_term
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.pipeline import MAX_FRAMES
from controlmm.pipelines.presets import Preset
from controlmm.pipelines.reach import check_reach
from controlmm.pipelines.source_motion import Interval
from controlmm.pipelines.token_drawing import drawn_latents

if TYPE_CHECKING:
    from controlmm.pipelines.controlmm import ControlMM

_RESIDUAL_GUIDANCE = 2.0  # MoMask's, for edited motions


def run_edit(
    pipeline: ControlMM,
    motion: Motion,
    prompt: str,
    *,
    keep: Sequence[Interval],
    keep_parts: Sequence[str],
    controls: Sequence[Control],
    obstacles: Sequence[Obstacle | Avoid],
    objectives: Sequence[Objective],
    exact: bool,
    samples: int,
    preset: Preset,
    seed: int,
    progress: Progress | None,
) -> GenerationResult:
    """See :meth:`ControlMM.edit`."""
    started = time.perf_counter()
    check_sampling(samples=samples, seed=seed)
    scene = EditScene.of_call(
        motion,
        prompt,
        keep=keep,
        keep_parts=keep_parts,
        controls=controls,
        obstacles=obstacles,
        objectives=objectives,
        skeleton=pipeline.skeleton,
        max_frames=MAX_FRAMES,
    )
    if not exact and not keep:
        raise ValueError("`exact=False` is about `keep`, and nothing is kept by it. Leave one out.")
    frames = scene.source.num_frames
    padded = pipeline.padded_frames(frames)
    ids = _tokens(pipeline, scene, padded)
    text = pipeline.text_encoder.encode([scene.prompt]).pooled
    seeds, scales = clip_seeds(seed, samples), pipeline.guidance.under(preset)

    def edited(rows: Tensor, report: Progress | None) -> Tensor:
        count = len(rows)
        own_ids = ids.expand(count, -1, -1)
        request = DecodingRequest(
            text.expand(count, -1),
            torch.ones(own_ids.shape[:2], dtype=torch.bool),
            ClipNoise([seeds[row] for row in rows.tolist()]),
            steps=preset.steps,
            guidance_scale=scales.base,
            guided_share=scales.share,
            rules=preset.rules,
            progress=report,
            kept=_kept_tokens(pipeline, scene, own_ids),
            dtype=pipeline.drawing_dtype(preset),
        )
        return _edited(pipeline, scene, request, own_ids, preset, exact=exact)

    latents = in_shares(
        edited,
        [1.0] * samples,
        threads=share_count(preset, scene.terms(samples, padded)),
        progress=progress,
    )
    features = pipeline.decoder.clip_features(latents)[:, :frames]
    if pipeline.closes(preset, has_terms=bool(scene.terms(samples, padded))):
        _close(pipeline, scene, features, exact=exact)
    return edit_result(scene, features, latents, started)


def _close(pipeline: ControlMM, scene: EditScene, features: Float[Tensor, "B T D"], *, exact: bool) -> None:
    """Joints on controls and, with ``exact``, on what is kept; bones as long as those of the source."""
    source, shown, skeleton = scene.source, scene.shown, pipeline.skeleton
    reached = check_reach(scene.controls, skeleton, is_strict=False)
    is_kept = scene.kept[..., None] & (exact | ~scene.whole)[:, None, None]
    targets = torch.where(shown.mask & ~is_kept, shown.targets, source.joints)
    mask = (shown.mask & reached[:, None, None]) | is_kept
    targets, mask = (x.expand(len(features), -1, -1, -1) for x in (targets, mask))
    bones = bone_lengths(source.joints.double(), skeleton).mean(0)
    close_clips(features, targets, mask, [source.num_frames] * len(features), skeleton, bones=bones)


def _edited(
    pipeline: ControlMM,
    scene: EditScene,
    request: DecodingRequest,
    ids: Int[Tensor, "B L Q"],
    preset: Preset,
    *,
    exact: bool,
) -> Float[Tensor, "B L C"]:
    """Latents of some of the samples."""
    samples = len(ids)
    terms = scene.terms(samples, ids.shape[1] * pipeline.decoder.downsample)
    latents = _drawn(pipeline, scene, request, ids, terms, preset)
    objective = _final(pipeline, scene, terms, samples, preset, exact=exact)
    if not (objective.mask.any() or objective.terms):
        return latents
    may_change = (request.valid if exact else request.drawn)[..., None].float()
    progress = request.progress
    budget = preset.latent_budget(has_terms=bool(terms))
    return edit_latents(objective, latents, may_change, budget, progress=progress).latents


def _tokens(pipeline: ControlMM, scene: EditScene, padded: int) -> Int[Tensor, "1 L Q"]:
    """Codes of the source; its last frame is repeated to fill the last token."""
    features = scene.source.features.float()
    longer = torch.cat([features, features[-1:].expand(padded - len(features), -1)])
    ids: Tensor = pipeline.decoder.tokenizer.encode(pipeline.decoder.normalizer.normalize(longer)[None])
    return ids


def _kept_tokens(pipeline: ControlMM, scene: EditScene, ids: Int[Tensor, "B L Q"]) -> KeptTokens | None:
    """Tokens all of whose frames are kept as whole poses."""
    if not scene.whole.any():
        return None
    missing = ids.shape[1] * pipeline.decoder.downsample - len(scene.whole)
    whole = nn.functional.pad(scene.whole, (0, missing), value=True)
    return KeptTokens(ids, whole.unflatten(0, (ids.shape[1], -1)).all(1).expand(ids.shape[:2]))


def _drawn(
    pipeline: ControlMM,
    scene: EditScene,
    request: DecodingRequest,
    ids: Int[Tensor, "B L Q"],
    terms: tuple[JointTerm, ...],
    preset: Preset,
) -> Float[Tensor, "B L C"]:
    """Latents that follow the text, parts and controls, among the tokens that are kept."""
    if not scene.kept.any():
        base = pipeline.packed(pipeline.transformer, request.dtype)
        residual = pipeline.packed(pipeline.residual, request.dtype)
        base_ids = vary_tokens(base, replace(request, steps=VARIATION_STEPS), ids[..., 0])
        varied = fill_residual_layers(residual, base_ids, request, guidance_scale=_RESIDUAL_GUIDANCE)
        is_same = (base_ids == ids[..., 0])[..., None]
        return pipeline.decoder.tokenizer.quantizer.lookup(torch.where(is_same, ids, varied))
    if request.kept is not None:
        preset = replace(preset, residual_guidance_scale=_RESIDUAL_GUIDANCE)
    shown = scene.shown
    objective = _objective(pipeline, shown.targets, shown.mask, terms, len(ids), preset)
    branch = None if shown.is_empty else pipeline.control
    return drawn_latents(pipeline, request, objective, branch, preset)


def _final(
    pipeline: ControlMM,
    scene: EditScene,
    terms: tuple[JointTerm, ...],
    samples: int,
    preset: Preset,
    *,
    exact: bool,
) -> ControlObjective:
    """What latents are edited towards at the end: controls, parts, and whole poses if they are to be exact.

    Kept poses are thousands of coordinates, a control may be one: their errors are averaged apart.
    """
    shown = scene.shown
    held = scene.held & exact
    if shown.is_empty:
        return _objective(pipeline, scene.source.joints, held, terms, samples, preset)
    if held.any():
        padded = pipeline.padded_frames(len(held))
        terms = (*terms, held_term(scene.source.joints, held, samples=samples, padded=padded))
    return _objective(pipeline, shown.targets, shown.mask, terms, samples, preset)


def _objective(
    pipeline: ControlMM,
    targets: Float[Tensor, "T J 3"],
    mask: Bool[Tensor, "T J 3"],
    terms: tuple[JointTerm, ...],
    samples: int,
    preset: Preset,
) -> ControlObjective:
    missing = (0, 0, 0, 0, 0, pipeline.padded_frames(len(mask)) - len(mask))
    targets, mask = (nn.functional.pad(x, missing).expand(samples, -1, -1, -1) for x in (targets, mask))
    frames = torch.ones(mask.shape[:2], dtype=torch.bool)
    return ControlObjective(pipeline.decoder, targets, mask, frames, norm=preset.control_norm, terms=terms)


def edit_result(
    scene: EditScene, features: Float[Tensor, "B T D"], latents: Float[Tensor, "B L C"], started: float
) -> GenerationResult:
    """Motions in the world of the source, measured there; ``started`` is what the clock said then."""
    source, controls = scene.source, scene.controls
    joints = source.placed(recover_joints(features, joints=scene.skeleton.num_joints))
    world = source.placed(source.joints)
    errors = [
        control_error(joints, targets.expand_as(joints), mask.expand_as(joints))
        for targets, mask in (
            (world, scene.kept[..., None].expand_as(world)),
            (controls.targets, controls.mask),
        )
    ]
    extra = _extra(scene, world)
    motions = tuple(
        Motion(clip, features=own.contiguous(), skeleton=scene.skeleton, text=scene.prompt, extra=dict(extra))
        for clip, own in zip(joints, features, strict=True)
    )
    depth = penetration(joints, scene.obstacles, scene.skeleton)
    return GenerationResult(motions, torch.maximum(*errors), depth, latents, time.perf_counter() - started)


def _extra(scene: EditScene, world: Float[Tensor, "T J 3"]) -> dict[str, Any]:
    """Targets for pictures and files. Whole poses are none: thousands of points would hide the figure."""
    parts = (scene.kept & ~scene.whole[:, None])[..., None].expand_as(world)
    mask = parts | scene.controls.mask
    extra: dict[str, Any] = {}
    if mask.any():
        targets = torch.where(scene.controls.mask, scene.controls.targets, world * parts)
        extra |= {"targets": targets, "mask": mask}
    if scene.obstacles:
        extra["obstacles"] = scene.obstacles
    return extra
