"""The six body parts: an exact partition of the features of both skeletons."""

from __future__ import annotations

import pytest

from controlmm.motion.body_parts import PART_NAMES, body_parts, part_index, trajectory_joints
from controlmm.motion.layout import feature_layout
from controlmm.motion.skeleton import HUMANML3D, KIT


@pytest.mark.parametrize("skeleton", [HUMANML3D, KIT], ids=lambda skeleton: skeleton.name)
def test_every_channel_and_joint_belongs_to_exactly_one_part(skeleton):
    parts = body_parts(skeleton)
    channels = [channel for part in parts for channel in part.channels]
    assert sorted(channels) == list(range(skeleton.feature_dim))
    assert sorted(joint for part in parts for joint in part.joints) == list(range(skeleton.num_joints))
    assert tuple(part.name for part in parts) == PART_NAMES


def test_parts_have_the_published_widths_and_trajectory_joints():
    assert [len(part.channels) for part in body_parts(HUMANML3D)] == [7, 60, 48, 48, 50, 50]
    assert trajectory_joints(HUMANML3D) == (0, 15, 20, 21, 10, 11)


@pytest.mark.parametrize("skeleton", [HUMANML3D, KIT], ids=lambda skeleton: skeleton.name)
def test_trajectory_joints_are_the_six_control_joints(skeleton):
    assert sorted(trajectory_joints(skeleton)) == sorted(skeleton.control_joints)


def test_channels_are_in_the_published_order():
    """By hand from the table: root first four then its velocity; a joint's position, rotation, velocity."""
    root, _, left_arm, _, left_leg, right_leg = body_parts(HUMANML3D)
    assert root.channels == (0, 1, 2, 3, 193, 194, 195)
    first = 13  # left collar
    position, rotation, velocity = 4 + 3 * (first - 1), 67 + 6 * (first - 1), 193 + 3 * first
    assert left_arm.channels[:12] == (
        *range(position, position + 3),
        *range(rotation, rotation + 6),
        *range(velocity, velocity + 3),
    )
    assert left_leg.channels[-2:] == (259, 260)
    assert right_leg.channels[-2:] == (261, 262)


def test_contacts_of_kit_go_with_the_feet_that_they_describe():
    contacts = feature_layout(KIT).foot_contacts.start
    for part in body_parts(KIT)[4:]:
        for channel in part.channels[-2:]:
            assert KIT.foot_joints[channel - contacts] in part.joints


def test_an_unknown_part_is_named():
    assert part_index("left_arm") == 2
    with pytest.raises(ValueError, match=r"Unknown body part 'tail'\. Use one of: root, trunk, left_arm"):
        part_index("tail")
