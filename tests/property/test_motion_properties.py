"""Properties of the representation that hold for any walk, place, heading and mirroring."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from controlmm.motion.features import canonicalize, joints_to_features
from controlmm.motion.mirror import mirror_features, mirror_joints
from controlmm.motion.rotations import (
    matrix_to_rot6d,
    quat_between,
    quat_rotate,
    quat_to_matrix,
    rot6d_to_matrix,
)
from controlmm.ops import recover_joints

# float32 positions up to 15 m from the origin and 60 yaw increments; near 180 degrees the float32 heading of
# the public scripts is a hundred times less exact.
FLOAT32, NEARLY_BACKWARD = 1e-5, 1e-3

pytestmark = pytest.mark.filterwarnings("error")
few = settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
turns = st.floats(-6.0, 6.0)
headings = st.floats(-math.pi, math.pi)
places = st.tuples(st.floats(-10, 10), st.floats(-2, 2), st.floats(-10, 10))
numbers = st.floats(-1, 1, width=32)


@few
@given(turn=turns, heading=headings, place=places)
def test_canonical_clips_do_not_depend_on_place_and_heading(walk, yawed, turn, heading, place):
    joints = walk(12, turn=turn / 5)
    moved = yawed(joints, heading) + torch.tensor(place, dtype=torch.float64)
    torch.testing.assert_close(canonicalize(moved), canonicalize(joints), rtol=0, atol=NEARLY_BACKWARD)


@few
@given(turn=turns, speed=st.floats(0, 0.1))
def test_canonicalizing_twice_changes_nothing(walk, turn, speed):
    joints = canonicalize(walk(20, turn=turn, speed=speed))
    torch.testing.assert_close(canonicalize(joints), joints, rtol=0, atol=FLOAT32)


@few
@given(turn=turns)
def test_repaired_features_keep_every_distance_of_the_clip(walk, turn):
    """Decoding gives the clip up to one yaw about the first root: distances between joints stay."""
    joints = canonicalize(walk(60, turn=turn))
    decoded = recover_joints(joints_to_features(joints, public_quirks=False)[None])[0]
    distances = [
        (points[:-1:7].reshape(-1, 1, 3) - points[:-1:7].reshape(1, -1, 3)).norm(dim=-1)
        for points in (torch.cat([decoded, decoded[-1:]]), joints)
    ]
    torch.testing.assert_close(*distances, rtol=0, atol=NEARLY_BACKWARD)


@few
@given(turn=turns, public_quirks=st.booleans())
def test_mirroring_commutes_with_the_features(walk, turn, public_quirks):
    joints = canonicalize(walk(30, turn=turn))
    expected = mirror_features(joints_to_features(joints, public_quirks=public_quirks))
    actual = joints_to_features(mirror_joints(joints), public_quirks=public_quirks)
    torch.testing.assert_close(actual, expected, rtol=0, atol=FLOAT32)


@few
@given(source=st.tuples(numbers, numbers, numbers), target=st.tuples(numbers, numbers, numbers))
def test_the_shortest_rotation_takes_one_direction_to_the_other(source, target):
    source, target = (torch.tensor(vector, dtype=torch.float64) for vector in (source, target))
    lengths = source.norm() * target.norm()
    if lengths < 1e-6 or 1 + source @ target / lengths < 1e-6:
        return  # no direction, or nearly antiparallel: the axis is noise
    turned = quat_rotate(quat_between(source, target), source)
    torch.testing.assert_close(turned / source.norm(), target / target.norm(), rtol=0, atol=1e-9)


@few
@given(values=st.tuples(numbers, numbers, numbers, numbers))
def test_rotations_survive_their_six_numbers(values):
    quaternion = torch.tensor(values, dtype=torch.float64)
    if quaternion.norm() < 1e-3:
        return
    matrix = quat_to_matrix(quaternion)
    torch.testing.assert_close(rot6d_to_matrix(matrix_to_rot6d(matrix)), matrix, rtol=0, atol=1e-9)
    torch.testing.assert_close(matrix @ matrix.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-9)
    assert torch.linalg.det(matrix) == pytest.approx(1)
