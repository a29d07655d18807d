"""Body-part timelines: in tracks, or one pass an entry that holds what earlier entries decided.

Source: ControlMM, section 4 and its published code, which leaves the feature unfinished.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeVar, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from controlmm.controls import Avoid, Control, Obstacle, TimelineEntry, check_timeline, part_joints
from controlmm.generation.composition import TRANSITION
from controlmm.generation.noise import clip_seeds
from controlmm.generation.objective import control_error
from controlmm.generation.solvers import Progress
from controlmm.generation.terms import HeldTerm
from controlmm.motion.ground import grounded
from controlmm.motion.skeleton import Skeleton
from controlmm.ops import recover_joints
from controlmm.pipelines.checks import check_sampling
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.scene import Scene
from controlmm.pipelines.tracks import run_tracks

if TYPE_CHECKING:
    from controlmm.pipelines.pipeline import MotionPipeline

Plan = TypeVar("Plan")  # a pipeline's kind of preset
TimelineMethod = Literal["tracks", "passes", "published"]

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
    method: TimelineMethod,
    progress: Progress | None,
) -> GenerationResult:
    """See :meth:`MotionPipeline.timeline`."""
    entries = check_timeline(entries)
    if method not in get_args(TimelineMethod):
        raise ValueError(f"`method` must be one of {get_args(TimelineMethod)}, got {method!r}.")
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
    if method == "tracks":
        result = run_tracks(
            pipeline, scene, entries, samples=samples, preset=preset, seed=seed, progress=progress
        )
    else:
        hold_rest = method == "passes"
        preset = pipeline.open_ended(preset)  # what earlier passes decided may not fit the later body
        result = _run_passes(
            pipeline,
            scene,
            entries,
            samples=samples,
            preset=preset,
            seed=seed,
            hold_rest=hold_rest,
            progress=progress,
        )
    for motion in result:
        motion.extra["timeline"] = entries
    return result


def _run_passes(
    pipeline: MotionPipeline[Plan],
    scene: Scene,
    entries: Sequence[TimelineEntry],
    *,
    samples: int,
    preset: Plan,
    seed: int,
    hold_rest: bool,
    progress: Progress | None,
) -> GenerationResult:
    """One pass an entry, in their order."""
    started = time.perf_counter()
    latest: _Pass | None = None
    for index in range(len(entries)):
        latest = _run_pass(
            pipeline,
            scene,
            entries[: index + 1],
            latest,
            seeds=[(clip + index * _PASS_SEED) % 2**63 for clip in clip_seeds(seed, samples)],
            preset=preset,
            hold_rest=hold_rest,
            progress=progress,
        )
    assert latest is not None  # there is an entry
    taken = time.perf_counter() - started
    result = scene.result(latest.features, latest.latents, seconds_taken=taken, on_floor=False)
    return dataclasses.replace(result, control_error=latest.error)


@dataclass(frozen=True, eq=False)
class _Pass:
    """What one pass made: features and joints in the networks' frame, and how well it held what it had to."""

    latents: Float[Tensor, "B L C"]
    features: Float[Tensor, "B T D"]
    joints: Float[Tensor, "B T J 3"]
    error: Float[Tensor, "B"]


def _run_pass(
    pipeline: MotionPipeline[Plan],
    scene: Scene,
    entries: Sequence[TimelineEntry],
    before: _Pass | None,
    *,
    seeds: Sequence[int],
    preset: Plan,
    hold_rest: bool,
    progress: Progress | None,
) -> _Pass:
    """The pass of the last of ``entries``; the first one is as long as its entry, the others as the scene."""
    length = entries[-1].end if before is None else scene.frames
    samples, skeleton = len(seeds), pipeline.skeleton
    canonical = scene.canonical
    targets = canonical.targets[:length].expand(samples, -1, -1, -1)
    mask = canonical.mask[:length].expand(samples, -1, -1, -1)
    rest = torch.zeros_like(mask)
    if before is not None:
        known = before.joints.shape[1]
        held = nn.functional.pad(before.joints, (0, 0, 0, 0, 0, length - known))
        parts = _parts_of(entries[:-1], known, length, skeleton)[..., None] & ~mask
        targets, mask = torch.where(mask, targets, held), mask | parts
        if hold_rest:
            rest = _outside(entries[-1], known, length)[:, None, None] & ~mask
    everything = mask | rest
    on_floor = not everything[..., 1].any()
    padded = pipeline.padded_frames(length)
    terms = scene.terms(samples, padded=padded, skeleton=skeleton, frames=length, on_floor=on_floor)
    if rest.any():
        missing = (0, 0, 0, 0, 0, padded - length)
        terms = (*terms, HeldTerm(nn.functional.pad(targets, missing), nn.functional.pad(rest, missing)))
    latents = pipeline.generate_latents(
        pipeline.text_encoder.encode([entries[-1].prompt]).pooled.expand(samples, -1),
        lengths=[length] * samples,
        targets=targets,
        mask=mask,
        seeds=seeds,
        preset=preset,
        terms=terms,
        progress=progress,
    )
    features = pipeline.decoder.clip_features(latents)[:, :length]
    if on_floor:
        features = grounded(features)
    joints = recover_joints(features, joints=skeleton.num_joints)
    return _Pass(latents, features, joints, control_error(joints, targets, everything))


def _parts_of(
    entries: Sequence[TimelineEntry], known: int, length: int, skeleton: Skeleton
) -> Bool[Tensor, "T J"]:
    """Parts of earlier entries in their intervals, as far as there are frames."""
    pinned = torch.zeros(length, skeleton.num_joints, dtype=torch.bool)
    for entry in entries:
        pinned[entry.start : entry.end, list(part_joints(entry.part, skeleton))] = True
    pinned[known:] = False
    return pinned


def _outside(entry: TimelineEntry, known: int, length: int) -> Bool[Tensor, "T"]:
    """Frames outside an entry, but for a transition, as far as there are any."""
    frames = torch.arange(length)
    beside = (frames < entry.start - TRANSITION) | (frames >= entry.end + TRANSITION)
    return beside & (frames < known)
