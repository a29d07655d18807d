"""Body-part timelines: one pass an entry, each pass holds what earlier entries decided.

Source: ControlMM, section 4 and its published code, which leaves the feature unfinished.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from controlmm.controls import Avoid, Control, Obstacle, TimelineEntry, check_timeline, part_joints
from controlmm.generation.noise import clip_seeds
from controlmm.generation.objective import control_error
from controlmm.generation.solvers import Progress
from controlmm.motion.ground import grounded
from controlmm.motion.skeleton import Skeleton
from controlmm.ops import recover_joints
from controlmm.pipelines.checks import check_sampling
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.scene import Scene

if TYPE_CHECKING:
    from controlmm.pipelines.pipeline import MotionPipeline

Plan = TypeVar("Plan")  # a pipeline's kind of preset

TRANSITION = 5  # frames around an entry that no other holds, so that the motion can change over
_PASS_SEED = 0x632BE59BD9B4E019  # odd 64-bit constant: each pass draws its own noise


def run_timeline(
    pipeline: MotionPipeline[Plan],
    entries: Sequence[TimelineEntry],
    *,
    controls: Sequence[Control],
    obstacles: Sequence[Obstacle | Avoid],
    samples: int,
    preset: Plan,
    seed: int,
    hold_rest: bool,
    progress: Progress | None,
) -> GenerationResult:
    """See :meth:`MotionPipeline.timeline`."""
    started = time.perf_counter()
    entries = check_timeline(entries)
    check_sampling(samples=samples, seed=seed)
    frames = max(entry.end for entry in entries)
    if frames > pipeline.longest:
        raise ValueError(
            f"The timeline ends at frame {frames} ({frames / pipeline.skeleton.fps:g} s), but the networks "
            f"make at most {pipeline.longest} frames. Shorten it, or chain motions with `pipeline.chain`."
        )
    scene = Scene.of_call(
        "; ".join(entry.prompt for entry in entries),
        controls,
        obstacles=obstacles,
        seconds=None,
        frames=frames,
        skeleton=pipeline.skeleton,
        max_frames=pipeline.longest,
    )
    joints: Tensor | None = None  # of the latest pass
    for index, entry in enumerate(entries):
        length = entry.end if index == 0 else frames
        targets, mask = scene_targets(scene, samples, length)
        if joints is not None:
            so_far, known = entries[: index + 1], len(joints[0])
            pinned = _pinned(so_far, known, length, pipeline.skeleton, hold_rest=hold_rest)
            pinned = pinned[..., None] & ~mask
            held = nn.functional.pad(joints, (0, 0, 0, 0, 0, length - known))
            targets, mask = torch.where(pinned, held, targets), mask | pinned
        on_floor = not mask[..., 1].any()
        latents = pipeline.generate_latents(
            pipeline.text_encoder.encode([entry.prompt]).pooled.expand(samples, -1),
            lengths=[length] * samples,
            targets=targets,
            mask=mask,
            seeds=[(clip + index * _PASS_SEED) % 2**63 for clip in clip_seeds(seed, samples)],
            preset=preset,
            terms=scene.terms(
                samples,
                padded=pipeline.padded_frames(length),
                skeleton=pipeline.skeleton,
                frames=length,
                on_floor=on_floor,
            ),
            progress=progress,
        )
        features = pipeline.decoder.features(latents)[:, :length]
        if on_floor:
            features = grounded(features)
        joints = recover_joints(features, joints=pipeline.skeleton.num_joints)
    result = scene.result(features, latents, seconds_taken=time.perf_counter() - started, on_floor=False)
    for motion in result:
        motion.extra["timeline"] = entries
    error = control_error(recover_joints(features, joints=pipeline.skeleton.num_joints), targets, mask)
    return dataclasses.replace(result, control_error=error)


def scene_targets(
    scene: Scene, samples: int, length: int
) -> tuple[Float[Tensor, "B T J 3"], Bool[Tensor, "B T J 3"]]:
    """The caller's own targets, for each sample, in the first ``length`` frames."""
    canonical = scene.canonical
    targets = canonical.targets[:length].expand(samples, -1, -1, -1)
    return targets, canonical.mask[:length].expand(samples, -1, -1, -1)


def _pinned(
    entries: Sequence[TimelineEntry], known: int, length: int, skeleton: Skeleton, *, hold_rest: bool
) -> Bool[Tensor, "T J"]:
    """What the pass of the last entry keeps: the parts of earlier ones, and all outside its own interval."""
    pinned = torch.zeros(length, skeleton.num_joints, dtype=torch.bool)
    for entry in entries[:-1]:
        pinned[entry.start : entry.end, list(part_joints(entry.part, skeleton))] = True
    if hold_rest:
        pinned[: max(0, entries[-1].start - TRANSITION)] = True
        pinned[entries[-1].end + TRANSITION :] = True
    pinned[known:] = False  # no pass has made these frames yet
    return pinned
