"""Longer motions: clip after clip, each of which begins with the poses in which the one before ends."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from numbers import Real
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from controlmm.generation.noise import clip_seeds
from controlmm.generation.objective import control_error
from controlmm.generation.solvers import Progress
from controlmm.motion.ground import grounded
from controlmm.motion.motion import Motion
from controlmm.ops import recover_joints
from controlmm.pipelines.checks import MIN_FRAMES, check_sampling, frame_count
from controlmm.pipelines.closing import close_clips
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.source_motion import SourceMotion
from controlmm.text import check_prompt

if TYPE_CHECKING:
    from controlmm.pipelines.pipeline import MotionPipeline

Plan = TypeVar("Plan")  # a pipeline's kind of preset

_CLIP_SEED = 0x2545F4914F6CDD1D  # odd 64-bit constant: each clip draws its own noise


def run_chain(
    pipeline: MotionPipeline[Plan],
    clips: Sequence[tuple[str, float]],
    *,
    overlap: float,
    max_frames: int,
    samples: int,
    preset: Plan,
    seed: int,
    progress: Progress | None,
) -> GenerationResult:
    """See :meth:`MotionPipeline.chain`."""
    started = time.perf_counter()
    check_sampling(samples=samples, seed=seed)
    plan, shared = _checked(pipeline, clips, overlap, max_frames)
    seeds = clip_seeds(seed, samples)
    motions: list[Motion] = []
    errors = torch.zeros(samples)
    for index, (prompt, frames) in enumerate(plan):
        tails = [_tail(pipeline, motion, shared) for motion in motions]
        targets = torch.zeros(samples, frames, pipeline.skeleton.num_joints, 3)
        mask = torch.zeros(targets.shape, dtype=torch.bool)
        for row, tail in enumerate(tails):
            targets[row, :shared], mask[row, :shared] = tail.joints, True
        latents = pipeline.generate_latents(
            pipeline.text_encoder.encode([prompt]).pooled.expand(samples, -1),
            lengths=[frames] * samples,
            targets=targets,
            mask=mask,
            seeds=[(clip + index * _CLIP_SEED) % 2**63 for clip in seeds],
            preset=preset,
            progress=progress,
        )
        features = pipeline.decoder.clip_features(latents)[:, :frames]
        if pipeline.closes(preset, has_terms=False):
            close_clips(features, targets, mask, [frames] * samples, pipeline.skeleton)
        if not tails:
            features = grounded(features)
        joints = recover_joints(features, joints=pipeline.skeleton.num_joints)
        errors = torch.maximum(errors, control_error(joints, targets, mask))
        motions = [
            Motion(joints=joints[row], features=features[row].contiguous(), skeleton=pipeline.skeleton)
            if not tails
            else _joined(motions[row], tails[row], joints[row], features[row], shared)
            for row in range(samples)
        ]
    text = "; ".join(prompt for prompt, _ in plan)
    whole = tuple(Motion(motion.joints, skeleton=motion.skeleton, text=text) for motion in motions)
    return GenerationResult(whole, errors, torch.zeros_like(errors), latents, time.perf_counter() - started)


def _checked(
    pipeline: MotionPipeline[Any], clips: Sequence[tuple[str, float]], overlap: float, max_frames: int
) -> tuple[list[tuple[str, int]], int]:
    """Prompts with their frames, and the frames that neighbours share."""
    fps = pipeline.skeleton.fps
    if not isinstance(clips, Sequence) or isinstance(clips, str) or not clips:
        raise ValueError(f"`clips` must be a list of (prompt, seconds), got {clips!r}.")
    if not isinstance(overlap, Real) or not math.isfinite(overlap) or round(overlap * fps) < MIN_FRAMES:
        raise ValueError(f"`overlap` must be at least {MIN_FRAMES / fps:g} s, got {overlap!r}.")
    shared = round(overlap * fps)
    plan = []
    for index, clip in enumerate(clips):
        if isinstance(clip, str) or not isinstance(clip, Sequence) or len(clip) != 2:
            raise ValueError(f"`clips[{index}]` must be (prompt, seconds), got {clip!r}.")
        prompt, seconds = clip
        frames = frame_count(seconds=seconds, frames=None, skeleton=pipeline.skeleton, max_frames=max_frames)
        if frames <= 2 * shared:
            raise ValueError(
                f"`clips[{index}]` must last more than twice the overlap of {overlap:g} s, got {seconds:g} s."
            )
        plan.append((check_prompt(prompt), frames))
    return plan, shared


def _tail(pipeline: MotionPipeline[Any], motion: Motion, shared: int) -> SourceMotion:
    """The last frames as a motion of its own, from the features, which do not depend on what was before."""
    features = None if motion.features is None else motion.features[-shared:]
    end = Motion(motion.joints[-shared:], features=features, skeleton=motion.skeleton)
    return SourceMotion.of(end, skeleton=pipeline.skeleton, max_frames=shared)


def _joined(
    before: Motion, tail: SourceMotion, joints: Float[Tensor, "T J 3"], features: Tensor, shared: int
) -> Motion:
    """The motions one after the other; where both are, one fades into the other.

    The features are those of the new clip, behind padding: only its end is looked at again.
    """
    after = tail.placed(joints)
    share = torch.linspace(0, 1, shared)[:, None, None]
    blend = torch.lerp(before.joints[-shared:], after[:shared], share)
    whole = torch.cat([before.joints[:-shared], blend, after[shared:]])
    padded = nn.functional.pad(features, (0, 0, len(whole) - len(features), 0))
    return Motion(joints=whole, features=padded.contiguous(), skeleton=before.skeleton)
