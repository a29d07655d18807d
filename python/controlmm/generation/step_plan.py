"""Where feet should stand under a body that is led along a path.

Networks that have seen few paths slide the body along a new one and forget to step. Here the foot that moves
least stands, and the two take turns in steps as long as people's at that speed; the body turns with the path.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controlmm.motion.body_parts import body_parts
from controlmm.motion.heading import heading, turned
from controlmm.motion.skeleton import Skeleton

_Array = np.ndarray[Any, np.dtype[np.float64]]
_Frames = np.ndarray[Any, np.dtype[Any]]  # which they are, or for each whether it counts

# m/s of the slower foot while the body moves. Nine tenths of 92 recorded walks have below 0.22; with less
# than 0.5, motions that slide little would lose more than they gain (FID, jerk).
_SLIDES = 0.5
_SLOWEST, _FASTEST = 0.25, 2.0  # m/s of a walk: slower bodies stand, faster ones run and fly
_STEP_RATIO = 0.38  # metres of a step for each step a second; recorded walks have 0.36
_SHORTEST, _LONGEST = 0.3, 1.0  # seconds for which a foot stands alone
_UNUSUAL = 0.3  # m^2 that a step of the wrong length costs, like sliding: times its relative error squared
_BOTH_STAND = 1  # frames by which a foot comes down earlier and leaves later than its turn
_FORWARD = math.radians(70)  # who faces further away from the path sets out sideways or backwards
_SETTING_OUT = 1.0  # seconds of moving
_SMOOTH_SECONDS = 0.4  # over which directions of paths and speeds are taken


class Stance(NamedTuple):
    """Foot 0 (left) or 1 (right) stands from frame ``first`` to ``last``."""

    foot: int
    first: int
    last: int


def slides(
    joints: Float[Tensor, "T J 3"],
    targets: Float[Tensor, "T J 3"],
    mask: Bool[Tensor, "T J 3"],
    skeleton: Skeleton,
) -> bool:
    """Whether a walk's feet would slide if the body only were moved to its targets.

    ``False`` where there is nothing to plan: the pelvis has no targets, legs have, or it stands or runs.

    Args:
        joints: The motion that editing starts from, in the skeleton's unit.
        targets: What it should meet.
        mask: Where there are targets.
        skeleton: Whose ``J`` joints.
    """
    legs = [joint for part in body_parts(skeleton) if part.name.endswith("leg") for joint in part.joints]
    if len(joints) < 2 or not mask[:, 0, [0, 2]].any() or mask[:, legs].any():
        return False
    path = _led_path(joints, targets, mask, skeleton)
    feet = _placed(joints, path, np.zeros(len(path)), skeleton)[:, _balls(skeleton)]
    speeds = _smooth(np.linalg.norm(np.diff(feet, axis=0), axis=-1) * skeleton.fps, skeleton.fps)
    speed = _speed(path, skeleton.fps)[1:]
    moves = speed > _SLOWEST
    if not moves.any() or speed[moves].mean() > _FASTEST:
        return False
    return bool(speeds.min(1)[moves].mean() > _SLIDES)


def step_targets(
    joints: Float[Tensor, "T J 3"],
    targets: Float[Tensor, "T J 3"],
    mask: Bool[Tensor, "T J 3"],
    skeleton: Skeleton,
) -> tuple[Float[Tensor, "T J 3"], Bool[Tensor, "T J 3"]]:
    """``targets`` and ``mask`` with places for the balls of standing feet, and for hips that face the path.

    Hips are led where the pelvis alone has targets, and the start sets out forward.

    Args:
        joints: The motion that editing starts from, in the skeleton's unit.
        targets: What it should meet.
        mask: Where there are targets.
        skeleton: Whose ``J`` joints.
    """
    path = _led_path(joints, targets, mask, skeleton)
    moves = _speed(path, skeleton.fps) > _SLOWEST
    turn = np.zeros(len(path))
    faces = _turn_to_path(joints, path, moves, skeleton)
    if faces is not None and not mask[:, 1:].any():
        turn = faces
    places = _placed(joints, path, turn, skeleton)
    led_targets, led = targets.clone(), mask.clone()

    def lead(joint: int, frames: slice | _Frames, place: _Array) -> None:
        for axis, values in zip(
            (0, 2), torch.from_numpy(place / skeleton.metres).to(targets).mT, strict=True
        ):
            led_targets[frames, joint, axis], led[frames, joint, axis] = values, True

    balls = _balls(skeleton)
    for stance in alternate_stances(places[:, balls], path, skeleton.fps):
        frames, joint = slice(stance.first, stance.last + 1), balls[stance.foot]
        if _speed(path[frames], skeleton.fps).mean() > _SLOWEST:
            place = places[frames, joint].mean(0, keepdims=True)
            wider = slice(max(0, stance.first - _BOTH_STAND), stance.last + 1 + _BOTH_STAND)
            lead(joint, wider, place.repeat(len(path[wider]), axis=0))
    if turn.any():
        where = moves.nonzero()[0]
        for hip in skeleton.facing[:2]:
            lead(hip, where, places[where, hip])
    return led_targets, led


def alternate_stances(feet: _Array, path: _Array, fps: float) -> list[Stance]:
    """The turns in which two feet stand: those in which they slide least, with steps of usual lengths.

    The cheapest of all sequences, by dynamic programming over the frames at which turns end.

    Args:
        feet: (T, 2, 2) metres on the ground, left and right.
        path: (T, 2) metres, where the body is.
        fps: Frames a second.
    """
    ends = len(path) - 1
    squares = np.square(np.diff(feet, axis=0)).sum(-1)
    slid = np.concatenate([np.zeros((1, 2)), squares.cumsum(0)])
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(path, axis=0), axis=-1).cumsum()])
    shortest, longest = round(_SHORTEST * fps), round(_LONGEST * fps)
    best, begun = np.zeros((ends + 1, 2)), np.zeros((ends + 1, 2), dtype=int)
    for end in range(1, ends + 1):
        begin = np.arange(max(0, end - longest), end)
        is_cut = (begin == 0) | (end == ends)  # the clip shows a part of this turn only
        begin = begin[is_cut | (end - begin >= shortest)]
        is_cut = (begin == 0) | (end == ends)
        length = way[end] - way[begin]
        usual = np.sqrt(_STEP_RATIO * np.maximum(length / (end - begin) * fps, _SLOWEST))
        excess = length / usual - 1
        unusual = _UNUSUAL * np.square(np.where(is_cut, np.maximum(excess, 0), excess))
        for foot in (0, 1):
            costs = best[begin, 1 - foot] + slid[end, foot] - slid[begin, foot] + unusual
            least = int(costs.argmin())
            best[end, foot], begun[end, foot] = costs[least], begin[least]
    stances, end, foot = [], ends, int(best[ends].argmin())
    while end > 0:
        stances.append(Stance(foot, int(begun[end, foot]), end))
        end, foot = stances[-1].first, 1 - foot
    return stances[::-1]


def _balls(skeleton: Skeleton) -> list[int]:
    return [skeleton.left_foot[1], skeleton.right_foot[1]]


def _led_path(joints: Tensor, targets: Tensor, mask: Tensor, skeleton: Skeleton) -> _Array:
    """(T, 2) metres: where the pelvis will be, what it misses at targets spread over the frames between."""
    path = np.empty((len(joints), 2))
    for column, axis in enumerate((0, 2)):
        now = joints[:, 0, axis].double().numpy()
        frames = mask[:, 0, axis].numpy().nonzero()[0]
        missing = targets[frames, 0, axis].double().numpy() - now[frames]
        if not len(frames) or frames[0]:
            frames, missing = np.append(0, frames), np.append(0.0, missing)  # it starts at the origin
        path[:, column] = now + np.interp(np.arange(len(now)), frames, missing)
    return path * skeleton.metres


def _placed(joints: Tensor, path: _Array, turn: _Array, skeleton: Skeleton) -> _Array:
    """(T, J, 2) metres on the ground: the body turned about its pelvis, and carried to the path."""
    around = turned((joints - joints[:, :1]).double(), torch.from_numpy(turn)[:, None])
    placed: _Array = around[..., [0, 2]].numpy() * skeleton.metres + path[:, None]
    return placed


def _turn_to_path(joints: Tensor, path: _Array, moves: _Frames, skeleton: Skeleton) -> _Array | None:
    """Radians to turn the body by so that it faces along the path; ``None`` unless it sets out forward."""
    where = moves.nonzero()[0]
    if not len(where):
        return None
    x, z = np.gradient(_smooth(path, skeleton.fps), axis=0).T
    direction = np.unwrap(np.arctan2(x, z)[where])
    wanted = np.interp(np.arange(len(path)), where, direction)
    turn: _Array = np.angle(np.exp(1j * (wanted - heading(joints, skeleton).double().numpy())))
    first = turn[where[: round(_SETTING_OUT * skeleton.fps)]]
    return turn if np.median(np.abs(first)) < _FORWARD else None


def _speed(path: _Array, fps: float) -> _Array:
    """(T,) m/s."""
    if len(path) < 2:
        return np.zeros(len(path))
    speed: _Array = np.linalg.norm(np.gradient(_smooth(path, fps), axis=0), axis=-1) * fps
    return speed


def _smooth(values: _Array, fps: float) -> _Array:
    """(T, N) averaged over neighbouring frames, with bell-shaped weights; ends are held."""
    reach = round(0.5 * _SMOOTH_SECONDS * fps)
    weights = np.hanning(2 * reach + 3)[1:-1]
    longer = np.concatenate([values[:1].repeat(reach, 0), values, values[-1:].repeat(reach, 0)])
    columns = [np.convolve(column, weights / weights.sum(), "valid") for column in longer.T]
    return np.stack(columns, axis=1)
