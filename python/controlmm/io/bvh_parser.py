"""Parses BVH text into joints and channel values, and turns those into joint positions."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from controlmm.io.euler import matrix_from_euler

_POSITIONS = ("Xposition", "Yposition", "Zposition")
_ROTATIONS = ("Xrotation", "Yrotation", "Zrotation")
_MAX_JOINTS = 10_000


@dataclass
class BvhJoint:
    """One joint of the file, as written there."""

    name: str
    parent: int  # index of the parent, -1 for the root
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    channels: tuple[str, ...] = ()


@dataclass
class BvhClip:
    """A parsed file: ``values`` is (T, C), all channels in file order, in degrees and the file's unit."""

    joints: list[BvhJoint] = field(default_factory=list)
    frame_time: float = 0.0
    values: Float[ndarray, "T C"] = field(default_factory=lambda: np.zeros((0, 0)))


class BvhSyntaxError(ValueError):
    """The text is not a well-formed BVH file; the message begins with the line number."""

    def __init__(self, line: int, problem: str) -> None:
        super().__init__(f"line {line}: {problem}")


class _Lines:
    """The non-empty lines of the text, split into words, each with its number."""

    def __init__(self, text: str) -> None:
        numbered = ((number, line.split()) for number, line in enumerate(text.splitlines(), start=1))
        self._rows = [(number, words) for number, words in numbered if words]
        self._next = 0
        self.number = 0

    def take(self, expected: str) -> list[str]:
        if self._next == len(self._rows):
            raise BvhSyntaxError(self.number + 1, f"the file ends where {expected} should be.")
        self.number, words = self._rows[self._next]
        self._next += 1
        return words

    def expect(self, *words: str) -> list[str]:
        """The rest of the next line, which must begin with ``words``."""
        found = self.take(repr(" ".join(words)))
        if tuple(found[: len(words)]) != words:
            raise BvhSyntaxError(self.number, f"expected {' '.join(words)!r}, found {_shown(found)}.")
        return found[len(words) :]

    def number_of(self, words: list[str], count: int, convert: Callable[[str], float]) -> list[float]:
        try:
            values = [convert(word) for word in words]
        except ValueError:
            raise BvhSyntaxError(self.number, f"expected {count} numbers, found {_shown(words)}.") from None
        if len(values) != count or not all(math.isfinite(value) for value in values):
            raise BvhSyntaxError(
                self.number, f"expected {count} finite numbers, found {len(values)} ({_shown(words)})."
            )
        return values


def _shown(words: list[str]) -> str:
    text = " ".join(words)
    return repr(text if len(text) <= 40 else text[:40] + "...")


def parse_bvh(text: str) -> BvhClip:
    """Parse the text of a BVH file.

    Raises:
        BvhSyntaxError: If it is malformed or cut short; the message names the line.
    """
    lines = _Lines(text)
    lines.expect("HIERARCHY")
    clip = BvhClip(joints=_parse_hierarchy(lines))
    lines.expect("MOTION")
    frames = int(lines.number_of(lines.expect("Frames:"), 1, int)[0])
    if frames < 1:
        raise BvhSyntaxError(lines.number, f"expected at least one frame, found {frames}.")
    clip.frame_time = lines.number_of(lines.expect("Frame", "Time:"), 1, float)[0]
    if clip.frame_time <= 0:
        raise BvhSyntaxError(lines.number, f"expected a positive frame time, found {clip.frame_time}.")
    count = sum(len(joint.channels) for joint in clip.joints)
    rows = [lines.number_of(lines.take(f"frame {i + 1} of {frames}"), count, float) for i in range(frames)]
    clip.values = np.array(rows, dtype=np.float64)
    return clip


def _parse_hierarchy(lines: _Lines) -> list[BvhJoint]:
    joints = [BvhJoint(name=_name(lines, lines.expect("ROOT")), parent=-1)]
    lines.expect("{")
    open_joints = [0]
    while open_joints:
        words = lines.take("a joint, CHANNELS, OFFSET or '}'")
        current = joints[open_joints[-1]]
        if words[0] == "OFFSET":
            x, y, z = lines.number_of(words[1:], 3, float)
            current.offset = (x, y, z)
        elif words[0] == "CHANNELS":
            current.channels = _channels(lines, words[1:])
        elif words[0] == "JOINT":
            joints.append(BvhJoint(name=_name(lines, words[1:]), parent=open_joints[-1]))
            lines.expect("{")
            open_joints.append(len(joints) - 1)
        elif words == ["End", "Site"]:
            _skip_end_site(lines)
        elif words == ["}"]:
            open_joints.pop()
        else:
            raise BvhSyntaxError(
                lines.number, f"expected a joint, CHANNELS, OFFSET or '}}', found {_shown(words)}."
            )
        if len(joints) > _MAX_JOINTS:
            raise BvhSyntaxError(lines.number, f"more than {_MAX_JOINTS} joints.")
    return joints


def _name(lines: _Lines, words: list[str]) -> str:
    if not words:
        raise BvhSyntaxError(lines.number, "expected the name of a joint.")
    return " ".join(words)


def _skip_end_site(lines: _Lines) -> None:
    lines.expect("{")
    lines.number_of(lines.expect("OFFSET"), 3, float)
    lines.expect("}")


def _channels(lines: _Lines, words: list[str]) -> tuple[str, ...]:
    count = int(lines.number_of(words[:1], 1, int)[0])
    names = tuple(words[1:])
    if len(names) != count or len(set(names)) != count or not set(names) <= {*_POSITIONS, *_ROTATIONS}:
        raise BvhSyntaxError(
            lines.number, f"expected {count} different channels such as Xposition, found {_shown(words[1:])}."
        )
    rotations = [name for name in names if name in _ROTATIONS]
    if len(rotations) not in (0, 3):
        raise BvhSyntaxError(
            lines.number, f"expected three rotation channels or none, found {len(rotations)}."
        )
    return names


def bvh_positions(clip: BvhClip) -> Float[ndarray, "T N 3"]:
    """Global position of every joint of the file, in its unit. Position channels replace the OFFSET."""
    positions: list[ndarray] = []
    rotations: list[ndarray] = []
    start = 0
    for joint in clip.joints:
        values = clip.values[:, start : start + len(joint.channels)]
        start += len(joint.channels)
        offset = _offset(joint, values)
        rotation = _rotation(joint, values)
        if joint.parent < 0:
            positions.append(offset)
            rotations.append(rotation)
            continue
        turned = (rotations[joint.parent] @ offset[..., None])[..., 0]
        positions.append(positions[joint.parent] + turned)
        rotations.append(rotations[joint.parent] @ rotation)
    return np.stack(positions, axis=1)


def _offset(joint: BvhJoint, values: Float[ndarray, "T C"]) -> Float[ndarray, "T 3"]:
    offset = np.tile(np.array(joint.offset), (len(values), 1))
    for axis, name in enumerate(_POSITIONS):
        if name in joint.channels:
            offset[:, axis] = values[:, joint.channels.index(name)]
    return offset


def _rotation(joint: BvhJoint, values: Float[ndarray, "T C"]) -> Float[ndarray, "T 3 3"]:
    columns = [i for i, name in enumerate(joint.channels) if name in _ROTATIONS]
    if not columns:
        return np.tile(np.eye(3), (len(values), 1, 1))
    order = "".join(joint.channels[i][0] for i in columns)
    return matrix_from_euler(np.radians(values[:, columns]), order)
