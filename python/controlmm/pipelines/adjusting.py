"""Moving the targets of a motion that is there: editing that starts from the last result."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.controls import Control, densify
from controlmm.generation.control_residuals import ControlResiduals
from controlmm.generation.solvers import Stopping, gauss_newton
from controlmm.motion.ground import lifted
from controlmm.motion.layout import feature_layout
from controlmm.motion.skeleton import skeleton_of_width
from controlmm.ops import recover_joints
from controlmm.pipelines.closing import close_clips
from controlmm.pipelines.output import GenerationResult
from controlmm.pipelines.placement import moved
from controlmm.pipelines.reach import check_reach
from controlmm.pipelines.scene import Scene

if TYPE_CHECKING:
    from controlmm.generation.motion_decoder import MotionDecoder

_ITERATIONS = 40


def adjusted(
    decoder: MotionDecoder,
    result: GenerationResult,
    controls: Sequence[Control],
    *,
    hold_frames: int,
    tolerance: float,
) -> GenerationResult:
    """See :meth:`controlmm.pipelines.ControlMM.adjust`."""
    started = time.perf_counter()
    _check(result, hold_frames=hold_frames, tolerance=tolerance)
    motion = result.motions[0]
    frames, skeleton = motion.num_frames, decoder.normalizer.skeleton
    dense = densify(controls, frames, skeleton)
    reached = check_reach(dense, skeleton, is_strict=False)
    origin = motion.joints[0, 0] * motion.joints.new_tensor([1, 0, 1])
    scene = Scene(motion.text, frames, dense, origin)
    canonical, count = moved(dense, -origin), len(result)
    padded = result.latents.shape[1] * decoder.downsample
    targets, mask = (
        torch.nn.functional.pad(x.expand(count, -1, -1, -1), (0, 0, 0, 0, 0, padded - frames))
        for x in (canonical.targets, canonical.mask)
    )
    keep = torch.ones(count, result.latents.shape[1], 1)
    keep[:, : -(-hold_frames // decoder.downsample)] = 0
    residuals = ControlResiduals(
        decoder,
        targets,
        mask,
        torch.ones(count, padded, dtype=torch.bool),
        prefix=result.latents if hold_frames else None,
        prefix_frames=hold_frames,
    )
    stopping = Stopping(iterations=_ITERATIONS, error=tolerance)
    solution = gauss_newton(residuals, result.latents, keep, stopping)
    features = decoder.clip_features(solution.latents)[:, :frames]
    held = _held_features(result, hold_frames) if hold_frames else features[:, :0]
    if hold_frames and scene.stands_on_floor:  # as high above the ground as what is held
        features = lifted(features, _rise(held, decoder.clip_features(result.latents)))
    features[:, :hold_frames] = held
    wanted, within = targets[:, :frames].clone(), mask[:, :frames] & reached[:, None, None]
    wanted[:, :hold_frames] = recover_joints(held, joints=skeleton.num_joints)
    within[:, :hold_frames] = True
    reports = close_clips(features, wanted, within, [frames] * count, skeleton)
    _hold(features, held)
    return scene.result(
        features,
        solution.latents,
        seconds_taken=time.perf_counter() - started,
        on_floor=scene.stands_on_floor and not hold_frames,
        exact=reports,
    )


def _held_features(result: GenerationResult, frames: int) -> Float[Tensor, "S H D"]:
    """Of the first frames as they were returned."""
    clips = []
    for motion in result:
        assert motion.features is not None  # of every motion that a call returns
        clips.append(motion.features[:frames])
    return torch.stack(clips)


def _hold(features: Float[Tensor, "S T D"], held: Float[Tensor, "S H D"]) -> None:
    """The held frames to the bit; but velocities of the last one lead to the first that may move."""
    layout, frames = feature_layout(skeleton_of_width(held.shape[-1])), held.shape[1]
    ways = (layout.root_yaw_velocity, layout.root_velocity, layout.joint_velocities)
    onwards = [features[:, frames - 1 : frames, way].clone() for way in ways]
    features[:, :frames] = held
    if frames:
        for way, velocities in zip(ways, onwards, strict=True):
            features[:, frames - 1 : frames, way] = velocities


def _rise(held: Float[Tensor, "S H D"], decoded: Float[Tensor, "S T D"]) -> Float[Tensor, "S"]:
    """How much higher the root is than decoded; closing has moved it, so the middle frame's."""
    height = feature_layout(skeleton_of_width(held.shape[-1])).root_height
    rises: Tensor = (held - decoded[:, : held.shape[1]])[..., height].flatten(1).median(1).values
    return rises


def _check(result: GenerationResult, *, hold_frames: int, tolerance: float) -> None:
    if not isinstance(result, GenerationResult):
        raise TypeError(
            f"`result` must be what a call of the pipeline returned, got {type(result).__name__}."
        )
    frames = result.motions[0].num_frames
    if isinstance(hold_frames, bool) or not isinstance(hold_frames, int) or not 0 <= hold_frames < frames:
        raise ValueError(f"`hold_frames` must be a whole number from 0 to {frames - 1}, got {hold_frames!r}.")
    if not tolerance > 0:
        raise ValueError(f"`tolerance` must be a positive number of metres, got {tolerance!r}.")
