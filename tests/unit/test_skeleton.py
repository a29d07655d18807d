"""Skeletons and the layout of their features."""

from __future__ import annotations

import pytest

from controlmm.motion.layout import feature_layout
from controlmm.motion.skeleton import HUMANML3D, KIT, skeleton_of_joints, skeleton_of_width


@pytest.mark.parametrize("skeleton", [HUMANML3D, KIT], ids=lambda s: s.name)
def test_tables_describe_every_joint(skeleton):
    count = skeleton.num_joints
    for table in (skeleton.parents, skeleton.directions, skeleton.mirror):
        assert len(table) == count
    assert all(parent < joint for joint, parent in enumerate(skeleton.parents))
    bones = {(chain[i], chain[i + 1]) for chain in skeleton.chains for i in range(len(chain) - 1)}
    assert bones == {(parent, joint) for joint, parent in enumerate(skeleton.parents) if parent >= 0}


@pytest.mark.parametrize("skeleton", [HUMANML3D, KIT], ids=lambda s: s.name)
def test_mirroring_twice_gives_every_joint_back(skeleton):
    assert tuple(skeleton.mirror[j] for j in skeleton.mirror) == tuple(range(skeleton.num_joints))
    sides = {skeleton.mirror[joint] for joint in skeleton.left_foot}
    assert sides == set(skeleton.right_foot)


# humanml3d.md, section 1
SLICES = {
    "humanml3d": [(0, 1), (1, 3), (3, 4), (4, 67), (67, 193), (193, 259), (259, 263)],
    "kit": [(0, 1), (1, 3), (3, 4), (4, 64), (64, 184), (184, 247), (247, 251)],
}


@pytest.mark.parametrize("skeleton", [HUMANML3D, KIT], ids=lambda s: s.name)
def test_layout_is_the_published_one(skeleton):
    groups = feature_layout(skeleton).groups
    assert [(group.start, group.stop) for group in groups] == SLICES[skeleton.name]
    assert groups[-1].stop == skeleton.feature_dim


def test_skeletons_are_found_by_width_and_joint_count():
    assert skeleton_of_width(263) is skeleton_of_joints(22) is HUMANML3D
    assert skeleton_of_width(251) is skeleton_of_joints(21) is KIT
    with pytest.raises(ValueError, match=r"263 wide .* 251 wide .* got 259"):
        skeleton_of_width(259)
    with pytest.raises(ValueError, match=r"22 .* 21 .* got 24"):
        skeleton_of_joints(24)


def test_joints_are_found_by_name_and_index():
    assert HUMANML3D.joint_index("right_wrist") == HUMANML3D.joint_index(21) == 21
    with pytest.raises(ValueError, match=r"Unknown joint 'tail'.*left_wrist"):
        HUMANML3D.joint_index("tail")
    with pytest.raises(ValueError, match=r"must be in 0\.\.21, got 22"):
        HUMANML3D.joint_index(22)


def test_contact_channels_follow_the_published_foot_order():
    assert HUMANML3D.foot_joints == (7, 10, 8, 11)
    assert KIT.foot_joints == (19, 20, 14, 15)
