"""What a person does, measured on the joints: turns, ways, raised hands, bows, jumps; no network involved.

All facts are numbers with a unit in metres, seconds, degrees. Signed facts count the body's left (+X when it
faces +Z) as positive.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

_FPS = 20.0
_LEFT_HIP, _RIGHT_HIP, _NECK, _HEAD = 1, 2, 12, 15
_SIDES = {  # shoulder, elbow, wrist, ankle, ball of the foot
    "left": (16, 18, 20, 7, 10),
    "right": (17, 19, 21, 8, 11),
}
_SMOOTHING = 9  # frames (0.45 s) of the window that takes the swing of a step out of heading and way
_ENDS = 5  # frames at the beginning and end that heading and place are averaged over
_SWING = 0.06  # metres that a raised hand must go to and fro to swing
_CLEAR = 0.05  # metres above its lowest, from which on a foot does not stand
_UPRIGHT = 0.75  # of the greatest pelvis height: lower is no bow but a crouch
SIGNED = ("turn", "leftward", "leftward_speed")  # change sign in a mirror

Range = tuple[float | None, float | None]


def measured_facts(joints: Float[Tensor, "T J 3"]) -> dict[str, float]:
    """Facts of a HumanML3D motion: global joints in metres, Y up, 20 fps, at least 10 frames.

    Returns:
        ``turn`` (net, degrees), ``turned`` (degrees of turning to either side in all); ``forward``,
        ``leftward`` (metres from beginning to end, in the first frames' heading), ``path`` (metres),
        ``speed`` (m/s over the whole motion), ``forward_speed``, ``leftward_speed`` (m/s in the body's own
        heading); ``lowering`` (metres that the pelvis sinks below its greatest height), ``jump`` (metres that
        both feet are above their lowest at once), ``bow`` (degrees that the trunk leans forward at most, legs
        not bent);
        and for ``left`` and ``right`` ``_hand_up`` (seconds with the wrist above its shoulder),
        ``_hand_overhead`` (seconds with it above the head), ``_hand_swings`` (turning points of a raised
        hand), ``_foot_lift`` (metres that the foot's ball rises above its lowest, the other foot standing).

    Raises:
        ValueError: If the motion has another skeleton or fewer than 10 frames.
    """
    if joints.ndim != 3 or joints.shape[1:] != (22, 3) or len(joints) < 2 * _ENDS:
        raise ValueError(
            f"`joints` must have shape (T, 22, 3), T at least {2 * _ENDS}, got {tuple(joints.shape)}."
        )
    joints = joints.double()
    facts = {**_way_and_turn(joints), **_trunk_and_feet(joints)}
    for side in _SIDES:
        facts |= _hand(joints, side)
    return facts


def holds(facts: Mapping[str, float], expected: Mapping[str, Range]) -> bool:
    """Whether every fact named in ``expected`` lies in its range (``None`` is open)."""
    return not missed(facts, expected)


def missed(facts: Mapping[str, float], expected: Mapping[str, Range]) -> list[str]:
    """The names of the facts that lie outside what was expected."""
    return [
        name
        for name, (low, high) in expected.items()
        if not (-math.inf if low is None else low) <= facts[name] <= (math.inf if high is None else high)
    ]


def mirrored_expectation(expected: Mapping[str, Range]) -> dict[str, Range]:
    """What to expect of the mirror image: left and right change places, signed ranges change sign."""
    swapped = {}
    for name, (low, high) in expected.items():
        if name in SIGNED:
            low, high = (None if high is None else -high), (None if low is None else -low)
        for side, other in (("left_", "right_"), ("right_", "left_")):
            if name.startswith(side):
                name = other + name.removeprefix(side)
                break
        swapped[name] = (low, high)
    return swapped


def _way_and_turn(joints: Float[Tensor, "T J 3"]) -> dict[str, float]:
    forward = _forward(joints)
    yaw = _unwrapped(torch.atan2(forward[:, 0], forward[:, 1]))
    ground = _smoothed(joints[:, 0][:, [0, 2]])
    step = ground.diff(dim=0)
    seconds = (len(joints) - 1) / _FPS
    left = torch.stack([forward[:, 1], -forward[:, 0]], dim=1)
    way = ground[-_ENDS:].mean(0) - ground[:_ENDS].mean(0)
    ahead = torch.nn.functional.normalize(forward[:_ENDS].mean(0), dim=0)
    path = step.norm(dim=1).sum()
    return {
        "turn": math.degrees(yaw[-_ENDS:].mean() - yaw[:_ENDS].mean()),
        "turned": math.degrees(yaw.diff().abs().sum()),
        "forward": float(way @ ahead),
        "leftward": float(way[0] * ahead[1] - way[1] * ahead[0]),
        "path": float(path),
        "speed": float(path) / seconds,
        "forward_speed": float((step * forward[:-1]).sum()) / seconds,
        "leftward_speed": float((step * left[:-1]).sum()) / seconds,
    }


def _trunk_and_feet(joints: Float[Tensor, "T J 3"]) -> dict[str, float]:
    pelvis = joints[:, 0, 1]
    trunk = joints[:, _NECK] - joints[:, 0]
    forward = _forward(joints)
    lean = torch.atan2((trunk[:, [0, 2]] * forward).sum(1), trunk[:, 1])
    stands = pelvis >= _UPRIGHT * pelvis.max()
    height = {side: joints[:, list(_SIDES[side][3:]), 1] for side in _SIDES}
    lifted = {side: (h - h.amin(0)).amin(1) for side, h in height.items()}
    ball = {side: joints[:, _SIDES[side][4], 1] for side in _SIDES}
    facts = {
        "lowering": float(pelvis.max() - pelvis.min()),
        "jump": float(torch.minimum(lifted["left"], lifted["right"]).max()),
        "bow": math.degrees(lean[stands].max()),
    }
    for side, other in (("left", "right"), ("right", "left")):
        is_standing = lifted[other] <= _CLEAR
        heights = (ball[side] - ball[side].min())[is_standing]
        facts[f"{side}_foot_lift"] = float(heights.max()) if len(heights) else 0.0
    return facts


def _hand(joints: Float[Tensor, "T J 3"], side: str) -> dict[str, float]:
    shoulder, _, wrist, *_ = _SIDES[side]
    is_up = joints[:, wrist, 1] > joints[:, shoulder, 1]
    relative = joints[:, wrist] - joints[:, shoulder]
    forward = _forward(joints)
    across = relative[:, 0] * forward[:, 1] - relative[:, 2] * forward[:, 0]
    ahead = (relative[:, [0, 2]] * forward).sum(1)
    return {
        f"{side}_hand_up": float(is_up.sum()) / _FPS,
        f"{side}_hand_overhead": float((joints[:, wrist, 1] > joints[:, _HEAD, 1]).sum()) / _FPS,
        f"{side}_hand_swings": float(max(_turning_points(a, is_up) for a in (across, ahead, relative[:, 1]))),
    }


def _forward(joints: Float[Tensor, "T J 3"]) -> Float[Tensor, "T 2"]:
    """Unit vector (x, z) that the hips face, the sway of the steps taken out."""
    across = joints[:, _LEFT_HIP] - joints[:, _RIGHT_HIP]
    facing = torch.stack([-across[:, 2], across[:, 0]], dim=1)
    return torch.nn.functional.normalize(_smoothed(torch.nn.functional.normalize(facing, dim=1)), dim=1)


def _smoothed(values: Float[Tensor, "T N"]) -> Float[Tensor, "T N"]:
    """Moving average; beyond the ends values go on as they came, so that even ways stay as they are."""
    half = _SMOOTHING // 2
    before = 2 * values[:1] - values[1 : half + 1].flip(0)
    after = 2 * values[-1:] - values[-half - 1 : -1].flip(0)
    padded = torch.cat([before, values, after])
    return padded.unfold(0, _SMOOTHING, 1).mean(-1)


def _unwrapped(angles: Float[Tensor, "T"]) -> Float[Tensor, "T"]:
    steps = angles.diff()
    steps = torch.remainder(steps + math.pi, 2 * math.pi) - math.pi
    return torch.cat([angles[:1], angles[:1] + steps.cumsum(0)])


def _turning_points(values: Float[Tensor, "T"], counts: Tensor) -> int:
    """How often ``values`` turn back by at least ``_SWING`` while ``counts`` is true."""
    points, direction, extreme = 0, 0, float(values[0])
    for value, is_counted in zip(values.tolist(), counts.tolist(), strict=True):
        if not is_counted:
            direction, extreme = 0, value
        elif (direction >= 0 and value > extreme) or (direction <= 0 and value < extreme):
            direction, extreme = _followed(direction, extreme, value)
        elif abs(value - extreme) >= _SWING:
            points += direction != 0
            direction, extreme = (1 if value > extreme else -1), value
    return points


def _followed(direction: int, extreme: float, value: float) -> tuple[int, float]:
    """An unset direction is taken once the value has gone far enough."""
    if direction != 0:
        return direction, value
    if abs(value - extreme) < _SWING:
        return 0, extreme
    return (1 if value > extreme else -1), value
