"""One motion from parts of several: who moves a body part when, and the parts put onto one body.

Source: the multi-track timelines of MaskControl's published code, after STMC (Petrovich et al., 2024), which
copies parts of motions that were generated apart onto an empty canvas and leaves gaps between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.controls import TimelineEntry, part_joints
from controlmm.motion.body_parts import body_parts
from controlmm.motion.layout import feature_layout
from controlmm.motion.skeleton import Skeleton

TRANSITION = 5  # frames on either side of a change that belong to neither entry


@dataclass(frozen=True, eq=False)
class Tracks:
    """Which entry each body part follows, frame by frame.

    Attributes:
        owners: (T, P) index of the entry, for the parts of :func:`controlmm.motion.body_parts.body_parts`.
        known: (T, P) false within :data:`TRANSITION` frames of a change.
        skeleton: The joints.
    """

    owners: Int[Tensor, "T P"]
    known: Bool[Tensor, "T P"]
    skeleton: Skeleton

    @classmethod
    def of(cls, entries: Sequence[TimelineEntry], skeleton: Skeleton) -> Tracks:
        """Tracks of a timeline.

        A part follows the first entry that names it. One that no entry names follows the entry that moves the
        legs, else the first that is there; where there is none, the one before goes on.
        """
        frames, parts = max(entry.end for entry in entries), body_parts(skeleton)
        named = [_named_parts(entry, skeleton) for entry in entries]
        owners = torch.full((frames, len(parts)), -1)
        for index in reversed(range(len(entries))):  # earlier entries are written last
            owners[entries[index].start : entries[index].end, named[index]] = index
        carriers = torch.full((frames,), -1)
        for moves_legs in (False, True):
            for index in reversed(range(len(entries))):
                if moves_legs <= bool(named[index][_legs(skeleton)].any()):
                    carriers[entries[index].start : entries[index].end] = index
        carriers = _continued(carriers)
        owners = torch.where(owners < 0, carriers[:, None], owners)
        return cls(owners, _apart_from_changes(owners), skeleton)

    def span(self, entry: int) -> tuple[int, int]:
        """First frame of an entry's motion, and the frame after the last, transitions included."""
        frames = (self.owners == entry).any(1).nonzero()[:, 0]
        if not len(frames):
            return 0, 0
        first, last = int(frames[0]) - TRANSITION, int(frames[-1]) + 1 + TRANSITION
        return max(0, first), min(len(self.owners), last)

    @property
    def known_joints(self) -> Bool[Tensor, "T J"]:
        """Joints of parts that are known."""
        return self._joints_where(self.known)

    def joints_of(self, entry: int) -> Bool[Tensor, "T J"]:
        """Joints that follow an entry."""
        return self._joints_where(self.owners == entry)

    def _joints_where(self, parts: Bool[Tensor, "T P"]) -> Bool[Tensor, "T J"]:
        joints = torch.zeros(len(parts), self.skeleton.num_joints, dtype=torch.bool)
        for column, part in enumerate(body_parts(self.skeleton)):
            joints[:, list(part.joints)] = parts[:, column, None]
        return joints


def composed(
    tracks: Tracks, motions: Sequence[Float[Tensor, "T D"]], starts: Sequence[int]
) -> Float[Tensor, "T D"]:
    """Features of one body whose parts move as in the motions of their entries.

    Positions and the root's steps are right; rotations and velocities are those of the parts' own motions.

    Args:
        tracks: Who moves what.
        motions: De-normalised features of every entry's motion.
        starts: The frame of the timeline at which each of them begins.
    """
    frames = len(tracks.owners)
    canvas = torch.stack(
        [
            motion[(torch.arange(frames) - start).clamp(0, max(0, len(motion) - 1))]
            if len(motion)
            else torch.zeros(frames, motion.shape[-1])
            for motion, start in zip(motions, starts, strict=True)
        ]
    )  # (E, T, D), the ends repeated
    result = torch.zeros(frames, canvas.shape[-1])
    local = local_positions(canvas, tracks.skeleton)  # (E, T, J, 3)
    placed = torch.zeros(local.shape[1:])
    rows = torch.arange(frames)
    for column, part in enumerate(body_parts(tracks.skeleton)):
        owner, known = tracks.owners[:, column], tracks.known[:, column]
        channels, joints = list(part.channels), list(part.joints)
        result[:, channels] = _bridged(canvas[owner, rows][:, channels], known)
        own = local[owner, rows]
        hangs_on = tracks.skeleton.parents[part.joints[0]]
        if hangs_on >= 0:  # parents come first
            own = own + (placed[:, hangs_on] - own[:, hangs_on])[:, None]
        placed[:, joints] = _bridged(own[:, joints], known)
    layout = feature_layout(tracks.skeleton)
    result[:, layout.root_height] = placed[:, 0, 1:2]
    result[:, layout.local_positions] = placed[:, 1:].flatten(1)
    return result


def local_positions(features: Float[Tensor, "*B T D"], skeleton: Skeleton) -> Float[Tensor, "*B T J 3"]:
    """Joints in the heading frame of the root: x and z relative to it, y above the ground."""
    layout = feature_layout(skeleton)
    height = features[..., layout.root_height]
    root = torch.cat([torch.zeros_like(height), height, torch.zeros_like(height)], dim=-1)
    return torch.cat(
        [root[..., None, :], features[..., layout.local_positions].unflatten(-1, (-1, 3))], dim=-2
    )


def _named_parts(entry: TimelineEntry, skeleton: Skeleton) -> Bool[Tensor, "P"]:
    """Body parts that an entry's part has a joint of."""
    joints = set(part_joints(entry.part, skeleton))
    return torch.tensor([bool(joints & set(part.joints)) for part in body_parts(skeleton)])


def _legs(skeleton: Skeleton) -> Bool[Tensor, "P"]:
    return torch.tensor([part.name in ("root", "left_leg", "right_leg") for part in body_parts(skeleton)])


def _continued(carriers: Int[Tensor, "T"]) -> Int[Tensor, "T"]:
    """Where there is none (-1), the one before; at the beginning the first there is."""
    present = (carriers >= 0).nonzero()[:, 0]
    before = torch.searchsorted(present, torch.arange(len(carriers)), right=True) - 1
    return carriers[present[before.clamp(min=0)]]


def _apart_from_changes(owners: Int[Tensor, "T P"]) -> Bool[Tensor, "T P"]:
    known = torch.ones(owners.shape, dtype=torch.bool)
    for frame, part in (owners.diff(dim=0) != 0).nonzero().tolist():
        known[max(0, frame + 1 - TRANSITION) : frame + 1 + TRANSITION, part] = False
    return known


def _bridged(values: Float[Tensor, "T *N"], known: Bool[Tensor, "T"]) -> Float[Tensor, "T *N"]:
    """Values with an even way from the last known frame to the next where they are not known."""
    frames = known.nonzero()[:, 0]
    if len(frames) in (0, len(known)):
        return values
    at = torch.arange(len(known))
    after = torch.searchsorted(frames, at).clamp(max=len(frames) - 1)
    before = torch.where(known, after, (after - 1).clamp(min=0))
    first, last = frames[before], frames[after]
    share = ((at - first) / (last - first).clamp(min=1)).clamp(0, 1).reshape(-1, *[1] * (values.ndim - 1))
    return torch.lerp(values[first], values[last], share)
