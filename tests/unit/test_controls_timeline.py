"""Entries of a timeline and body parts: times, names, and what is refused."""

from __future__ import annotations

import pytest

from controlmm.controls import PARTS, TimelineEntry, check_timeline, part_joints
from controlmm.motion.skeleton import HUMANML3D


def test_seconds_and_frames_mean_the_same():
    by_time = TimelineEntry("upper", "a person waves", seconds=(1.5, 3))
    by_frame = TimelineEntry("upper", "a person waves", frames=(30, 60))
    assert by_time == by_frame
    assert by_time.label == "upper 1.5-3 s"


def test_parts_hold_the_joints_of_the_published_code():
    """Source: MaskControl's timeline demo and its multi-track table."""
    for part, joints in (
        ("lower", (0, 10, 11)),
        ("upper", (15, 20, 21)),
        ("left_arm", (18, 20)),
        ("right_arm", (19, 21)),
        ("legs", (4, 5, 10, 11)),
        ("spine", (0,)),
        ("head", (15,)),
        ("left_foot", (10,)),
        ("body", tuple(range(22))),
    ):
        assert part_joints(part, HUMANML3D) == joints
    assert all(part_joints(part, HUMANML3D) for part in PARTS)


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (
            lambda: TimelineEntry("uper", "wave", frames=(0, 20)),
            ValueError,
            r'part "uper"\. Did you mean "upper"\?',
        ),
        (lambda: TimelineEntry(3, "wave", frames=(0, 20)), TypeError, r"`part` must be a name"),
        (lambda: TimelineEntry("upper", " ", frames=(0, 20)), ValueError, r"`prompt` is empty"),
        (lambda: TimelineEntry("upper", None, frames=(0, 20)), TypeError, r"`prompt` must be a string"),
        (lambda: TimelineEntry("upper", "wave"), ValueError, r"Pass `seconds` or `frames`, one of them"),
        (
            lambda: TimelineEntry("upper", "wave", frames=(0, 7)),
            ValueError,
            r"at least 8 frames \(0\.4 s\), got .* 0 to 7",
        ),
        (lambda: TimelineEntry("upper", "wave", frames=(-1, 20)), ValueError, r"begin at 0 or later"),
        (
            lambda: TimelineEntry("upper", "wave", frames=(0.5, 20)),
            ValueError,
            r"`frames` must be two whole numbers",
        ),
        (
            lambda: TimelineEntry("upper", "wave", seconds=(0, float("nan"))),
            ValueError,
            r"`seconds` must be two numbers",
        ),
        (lambda: check_timeline([]), ValueError, r"`entries` is empty"),
        (
            lambda: check_timeline([("upper", "wave")]),
            TypeError,
            r"`entries\[0\]` must be a TimelineEntry, got tuple",
        ),
        (lambda: check_timeline("upper"), TypeError, r"`entries` must be a list of TimelineEntry"),
    ],
)
def test_mistakes_are_refused(make, kind, message):
    with pytest.raises(kind, match=message):
        make()
