"""Ready-made controls to play with: line, circle, zigzag, a wave of the wrist, a reach.

All start at the origin with the body facing +Z (its left is +X), as generated motion does. Ground paths leave
the height free and are followed over the whole clip at constant speed.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from controlmm.controls.document import FPS, ControlFile
from controlmm.controls.joint import JointControl
from controlmm.controls.path import PathControl

WALKING_SPEED = 1.2  # m/s, natural for an adult
RUNNING_SPEED = 2.0  # m/s, from here on people run
TOP_SPEED = 3.0  # m/s, faster than nearly all of the training data
MIN_SECONDS, MAX_SECONDS = 0.4, 9.8  # 8 and 196 frames, what the models take

_POINTS = 121  # on a curve; a circle of 2 m radius is then round to 1 mm
_WRIST_SIDE = 0.35  # metres from the body's middle to the drawn line
_WRIST_AHEAD = 0.25  # metres from the pelvis forward
_WRIST_HEIGHT = 1.2  # metres, a little below the shoulder
_WRIST_REACH = (0.95, 1.75)  # heights in metres that the arm reaches at that place
_Array = np.ndarray[Any, np.dtype[np.float64]]


def line(joint: str = "pelvis", *, length: float = 5.0, seconds: float | None = None) -> ControlFile:
    """Straight ahead for ``length`` metres.

    Args:
        joint: The joint that is led.
        length: Metres.
        seconds: Duration, 0.4 to 9.8; ``None`` takes a natural walking speed.

    Raises:
        ValueError: If ``length`` is not positive or ``seconds`` is out of range.
    """
    _check_positive(length=length)
    way = np.linspace(0.0, length, 2)
    return _ground_path(
        joint, np.zeros(2), way, length=length, seconds=seconds, words="forward in a straight line"
    )


def circle(
    joint: str = "pelvis", *, radius: float = 2.0, direction: str = "left", seconds: float | None = None
) -> ControlFile:
    """One full circle that starts straight ahead and turns to the body's ``direction``.

    Args:
        joint: The joint that is led.
        radius: Metres.
        direction: ``"left"`` (+X) or ``"right"``.
        seconds: Duration, 0.4 to 9.8; ``None`` takes a natural walking speed.

    Raises:
        ValueError: If ``radius`` is not positive, or ``direction`` or ``seconds`` is out of range.
    """
    _check_positive(radius=radius)
    if direction not in ("left", "right"):
        raise ValueError(f"`direction` must be 'left' or 'right', got {direction!r}.")
    side = 1.0 if direction == "left" else -1.0
    angle = np.linspace(0.0, 2.0 * math.pi, _POINTS)
    x, z = side * radius * (1.0 - np.cos(angle)), radius * np.sin(angle)
    words = f"in a circle to the {direction}"
    return _ground_path(joint, x, z, length=2.0 * math.pi * radius, seconds=seconds, words=words)


def zigzag(
    joint: str = "pelvis",
    *,
    length: float = 6.0,
    width: float = 1.2,
    turns: int = 4,
    seconds: float | None = None,
) -> ControlFile:
    """Ahead for ``length`` metres, swinging left and right with rounded corners.

    Args:
        joint: The joint that is led.
        length: Metres ahead.
        width: Metres from the leftmost to the rightmost point.
        turns: Number of corners.
        seconds: Duration, 0.4 to 9.8; ``None`` takes a natural walking speed.

    Raises:
        ValueError: If a size is not positive or ``seconds`` is out of range.
    """
    _check_positive(length=length, width=width, turns=turns)
    sharpness = 0.95  # 1 gives sharp corners, which no body can follow
    z = np.linspace(0.0, length, _POINTS)
    swing = np.arcsin(sharpness * np.sin(np.pi * turns * z / length)) / math.asin(sharpness)
    x = 0.5 * width * swing
    way = float(np.hypot(np.diff(x), np.diff(z)).sum())
    return _ground_path(joint, x, z, length=way, seconds=seconds, words="in a zigzag")


def wave(
    joint: str = "right_wrist", *, amplitude: float = 0.2, length: float = 5.0, period: float = 1.2,
    seconds: float | None = None,
) -> ControlFile:  # fmt: skip
    """A wrist drawn up and down along a sine, beside the body, while it walks ahead.

    Args:
        joint: ``"right_wrist"`` or ``"left_wrist"``.
        amplitude: Metres up and down from a height of 1.2 m.
        length: Metres that the body walks.
        period: Seconds of one wave.
        seconds: Duration, 0.4 to 9.8; ``None`` takes a natural walking speed.

    Raises:
        ValueError: If the joint is no wrist, a size is not positive or ``seconds`` is out of range.
    """
    _check_positive(amplitude=amplitude, length=length, period=period)
    side = _side_of_wrist(joint)
    _warn_out_of_reach(amplitude)
    seconds = _duration(length, seconds)
    frames = np.arange(round(seconds * FPS))
    height = _WRIST_HEIGHT + amplitude * np.sin(2.0 * math.pi * frames / (FPS * period))
    ahead = _WRIST_AHEAD + length * frames / (len(frames) - 1)
    points = np.stack([np.full(len(frames), side * _WRIST_SIDE), height, ahead], axis=1)
    hand = joint.split("_")[0]
    text = f"a person {_verb(length / seconds)} forward while the {hand} hand waves up and down"
    return ControlFile(
        [JointControl(joint, frames=frames, positions=_rounded(points))], seconds=seconds, text=text
    )


def reach(joint: str = "right_wrist", *, seconds: float = 4.0) -> ControlFile:
    """Key frames only: a standing person reaches forward at shoulder height, then up, with one hand.

    Args:
        joint: ``"right_wrist"`` or ``"left_wrist"``.
        seconds: Duration, 0.4 to 9.8.

    Raises:
        ValueError: If the joint is no wrist or ``seconds`` is out of range.
    """
    side = _side_of_wrist(joint)
    last = round(_checked_seconds(seconds) * FPS) - 1
    wrist = JointControl(
        joint,
        frames=[round(last / 3), round(2 * last / 3)],
        positions=[[side * 0.2, 1.35, 0.45], [side * 0.25, 1.75, 0.2]],
    )
    pelvis = PathControl("pelvis", xz=[[0.0, 0.0]] * 3, frames=[0, round(last / 2), last])
    hand = joint.split("_")[0]
    text = f"a person stands and reaches forward, then up, with the {hand} hand"
    return ControlFile([pelvis, wrist], seconds=seconds, text=text)


SHAPES: dict[str, Callable[..., ControlFile]] = {
    "line": line,
    "circle": circle,
    "zigzag": zigzag,
    "wave": wave,
    "reach": reach,
}


def _ground_path(
    joint: str, x: _Array, z: _Array, *, length: float, seconds: float | None, words: str
) -> ControlFile:
    seconds = _duration(length, seconds)
    path = PathControl(joint, xz=_rounded(np.stack([x, z], axis=1)))
    return ControlFile([path], seconds=seconds, text=f"a person {_verb(length / seconds)} {words}")


def _duration(length: float, seconds: float | None) -> float:
    """Seconds, on the grid of frames; warns when the way is too long for them."""
    if seconds is None:
        natural = round(length / WALKING_SPEED * FPS) / FPS
        seconds = min(max(natural, MIN_SECONDS), MAX_SECONDS)
    _checked_seconds(seconds)
    if length / seconds > TOP_SPEED:
        warnings.warn(
            f"{length:.1f} m in {seconds:g} s is {length / seconds:.1f} m/s; above {TOP_SPEED:g} m/s "
            f"the motion will look wrong. Choose a shorter way, or more seconds (up to {MAX_SECONDS}).",
            stacklevel=4,
        )
    return seconds


def _checked_seconds(seconds: float) -> float:
    if not MIN_SECONDS <= seconds <= MAX_SECONDS:
        raise ValueError(
            f"`seconds` must be from {MIN_SECONDS} to {MAX_SECONDS} (8 to 196 frames), got {seconds}."
        )
    return seconds


def _check_positive(**sizes: float) -> None:
    for name, size in sizes.items():
        if not (math.isfinite(size) and size > 0):
            raise ValueError(f"`{name}` must be positive, got {size}.")


def _side_of_wrist(joint: str) -> float:
    sides = {"left_wrist": 1.0, "right_wrist": -1.0}
    if joint not in sides:
        raise ValueError(f"`joint` must be one of {', '.join(sides)}, got {joint!r}.")
    return sides[joint]


def _warn_out_of_reach(amplitude: float) -> None:
    lowest, highest = _WRIST_HEIGHT - amplitude, _WRIST_HEIGHT + amplitude
    if lowest < _WRIST_REACH[0] or highest > _WRIST_REACH[1]:
        warnings.warn(
            f"an amplitude of {amplitude:g} m asks for wrist heights from {lowest:.2f} to {highest:.2f} m; "
            f"there the arm reaches from {_WRIST_REACH[0]} to {_WRIST_REACH[1]} m.",
            stacklevel=3,
        )


def _verb(speed: float) -> str:
    return "walks" if speed < RUNNING_SPEED else "runs"


def _rounded(points: _Array) -> _Array:
    """To a tenth of a millimetre, so that every platform writes the same file."""
    return np.round(points, 4) + 0.0  # + 0 turns -0 into 0
