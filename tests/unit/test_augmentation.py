"""Changed motions: what they must keep, and which captions stay true of them."""

from __future__ import annotations

import math

import pytest
import torch

from controlmm.data import Caption, FeatureClip
from controlmm.motion.features import bone_lengths, joints_to_features
from controlmm.motion.heading import heading
from controlmm.motion.skeleton import HUMANML3D, KIT
from controlmm.ops import recover_joints
from controlmm.training.augmentation import Augmentation, augmented
from controlmm.training.caption_truth import joined_captions, true_at_other_speed, true_on_bent_way
from controlmm.training.motion_changes import (
    BLEND_FRAMES,
    along_bent_way,
    at_speed,
    joined,
    pose_distance,
)

ROUNDING = 1e-9  # metres, float64
BONES = 1e-6  # metres; the synthetic walks' own bones vary by float64 rounding only
ARC = 3e-3  # the way is smoothed, so the ends of the arc are a little straighter
FEATURES = 2e-5  # metres: features are float32, their steps add up along a clip


def captions(*texts: str) -> tuple[Caption, ...]:
    return tuple(Caption(text) for text in texts)


@pytest.fixture
def straight(walk):
    """100 frames at 1 m/s along +Z."""
    return walk(100, turn=0.0, speed=0.05)


def assert_same_bones(joints: torch.Tensor, original: torch.Tensor) -> None:
    expected = bone_lengths(original, HUMANML3D).mean(0).expand(len(joints), -1)
    torch.testing.assert_close(bone_lengths(joints, HUMANML3D), expected, rtol=0, atol=BONES)


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.25])
def test_another_speed_is_the_same_way_in_less_time(straight, factor):
    changed = at_speed(straight, factor)
    assert len(changed) == int(99 / factor + 1e-6) + 1
    assert_same_bones(changed, straight)
    step = changed[1:, 0, 2] - changed[:-1, 0, 2]
    torch.testing.assert_close(step, torch.full_like(step, 0.05 * factor), rtol=0, atol=ROUNDING)
    for frame in range(0, len(changed), 5):  # where the old and the new frames meet
        old = frame * factor
        if abs(old - round(old)) < 1e-9:
            torch.testing.assert_close(changed[frame], straight[round(old)], rtol=0, atol=1e-7)


@pytest.mark.parametrize("degrees", [60.0, -40.0])
def test_a_bent_straight_way_is_an_arc_of_the_same_length(straight, degrees):
    """An arc of length s and angle a has the chord 2 s / a sin(a / 2), and its steps turn evenly."""
    bent = along_bent_way(straight, degrees)
    assert_same_bones(bent, straight)
    way, angle = 0.05 * 99, math.radians(degrees)
    chord = (bent[-1, 0] - bent[0, 0])[[0, 2]].norm()
    assert chord.item() == pytest.approx(abs(2 * way / angle * math.sin(angle / 2)), rel=ARC)
    steps = bent[:, 0].diff(dim=0)[:, [0, 2]].norm(dim=1)
    torch.testing.assert_close(steps, torch.full_like(steps, 0.05), rtol=0, atol=ROUNDING)
    turned = heading(bent[-1], HUMANML3D) - heading(straight[-1], HUMANML3D)
    assert turned.item() == pytest.approx(angle, abs=1e-6)
    torch.testing.assert_close(bent[..., 1], straight[..., 1], rtol=0, atol=ROUNDING)


def test_somebody_who_stands_is_not_turned(straight):
    standing = torch.cat([straight[:50], straight[49:50].expand(50, -1, -1)])
    bent = along_bent_way(standing, 60.0)
    # the way is smoothed over 11 frames, so the last turn comes 5 frames after the last step
    still = bent[56:]
    torch.testing.assert_close(still, still[:1].expand_as(still), rtol=0, atol=ROUNDING)


def test_joined_clips_are_continuous_and_keep_both(walk):
    """Blends of two phases of one walk: no joint jumps more than in the clips themselves, about."""
    first, second = walk(66, turn=0.5), walk(80, turn=-0.4, heading=1.0)
    both = joined(first, second)
    assert len(both) == 66 + 80 - BLEND_FRAMES
    assert_same_bones(both, first)
    assert torch.equal(both[: 66 - BLEND_FRAMES], first[:-BLEND_FRAMES])
    step = both.diff(dim=0).norm(dim=-1).max(dim=1).values
    usual = max(clip.diff(dim=0).norm(dim=-1).max().item() for clip in (first, second))
    assert step.max().item() < 1.5 * usual
    # the second clip is only set down elsewhere: its own shape is kept
    rest = both[66:]
    for a, b in ((10, 20), (0, 50)):
        expected = (second[BLEND_FRAMES + a] - second[BLEND_FRAMES + b]).norm(dim=-1)
        torch.testing.assert_close((rest[a] - rest[b]).norm(dim=-1), expected, rtol=0, atol=ROUNDING)


def test_the_second_clip_goes_on_in_the_heading_of_the_first(walk):
    """The first has turned by 70/73 of a right angle where the blend is; both are in the same phase there."""
    first, second = walk(74, turn=math.pi / 2), walk(66, turn=0.0)
    both = joined(first, second)
    direction = both[-1, 0] - both[-20, 0]
    end = math.pi / 2 * 70 / 73
    assert math.atan2(direction[0], direction[2]) == pytest.approx(end, abs=1e-6)
    assert pose_distance(first, second) < ROUNDING


def test_pose_distance_ignores_place_and_heading(walk, yawed):
    joints = walk(60)
    moved = yawed(joints, 1.3) + torch.tensor([3.0, 0.0, -1.0], dtype=torch.float64)
    lying = joints.clone()
    lying[:, 0, 1] -= 0.5
    middle_of_end = joints[: 60 - BLEND_FRAMES // 2 + 1 + BLEND_FRAMES // 2]
    same = torch.cat([joints[-BLEND_FRAMES // 2 - BLEND_FRAMES // 2 :], joints[-1:]])
    assert pose_distance(joints, same) == pytest.approx(pose_distance(moved, same), abs=1e-9)
    assert pose_distance(joints, same) < 1e-9
    assert pose_distance(middle_of_end, lying) > pose_distance(middle_of_end, joints)


def test_clips_shorter_than_the_blend_are_refused(walk):
    with pytest.raises(ValueError, match="Both clips need at least 8 frames to be joined, got 60 and 7"):
        joined(walk(60), walk(7))


@pytest.mark.parametrize("skeleton", [HUMANML3D, KIT], ids=lambda s: s.name)
def test_parents_come_before_their_children(skeleton):
    assert all(parent < joint for joint, parent in enumerate(skeleton.parents))


def test_captions_that_would_lie_are_left_out():
    walks = captions(
        "a person walks", "a person walks slowly", "she hurries along", "he strides at a fast pace"
    )
    assert [c.text for c in true_at_other_speed(walks)] == ["a person walks"]
    ways = captions(
        "a person walks forward",
        "someone walks in a straight line",
        "a man turns left",
        "he waves the right hand",
    )
    assert [c.text for c in true_on_bent_way(ways)] == ["a person walks forward"]
    partial = (Caption("a person walks", start=1.0, end=2.0),)
    assert true_on_bent_way(partial) == true_at_other_speed(partial) == ()


def test_joined_captions_name_one_person():
    first = captions("A person walks forward.", "someone runs the whole time", "walking ahead")
    second = captions("the man happily waves", "jumping", "a woman is bowing")
    assert joined_captions(first, second) == (
        Caption("a person walks forward, then happily waves", "joined"),
    )
    assert joined_captions(captions("a man jumps"), captions("a figure is bowing.", "she stands")) == (
        Caption("a man jumps, then is bowing", "joined"),
    )
    assert joined_captions(captions("running"), second) == ()


@pytest.fixture
def clips(walk):
    """Walks of several kinds, with features as the data folder has them."""
    texts = ("a person walks", "a man slowly turns left", "the woman walks in a straight line")
    made = []
    for index in range(6):
        joints = walk(70 + index, turn=0.3 * index, heading=0.0)
        joints = joints - joints[:1, :1] * torch.tensor([1.0, 0, 1.0], dtype=torch.float64)
        features = joints_to_features(joints, public_quirks=False)
        made.append(FeatureClip(f"clip{index}", features, captions(*texts), "lab"))
    return made


@pytest.mark.parametrize("kind", ["joined_share", "speed_share", "bent_share"])
def test_features_of_new_clips_are_those_of_their_joints(clips, kind):
    made = augmented(clips, Augmentation(**{kind: 1.0}))
    assert len(made) == 6
    for clip in made:
        assert clip.source == "lab"
        joints = recover_joints(clip.features[None].double(), joints=22)[0]
        again = recover_joints(joints_to_features(joints, public_quirks=False)[None], joints=22)[0]
        # a shorter clip smooths its first heading a little otherwise: compare up to a turn about the start
        turn = heading(joints[0], HUMANML3D) - heading(again[0].double(), HUMANML3D)
        x, y, z = again.double().unbind(-1)
        again = torch.stack([x * turn.cos() + z * turn.sin(), y, z * turn.cos() - x * turn.sin()], -1)
        torch.testing.assert_close(again, joints[: len(again)], rtol=0, atol=1e-4)
        assert bone_lengths(joints, HUMANML3D).std(0).max() < FEATURES
    texts = {caption.text for clip in made for caption in clip.captions}
    expected = {
        "joined_share": {"a person walks, then walks", "a man slowly turns left, then slowly turns left"},
        "speed_share": {"a person walks", "the woman walks in a straight line"},
        "bent_share": {"a person walks"},
    }[kind]
    assert texts & expected
    assert kind == "joined_share" or texts <= expected


def test_the_seed_decides_and_nothing_is_made_by_default(clips):
    assert augmented(clips, Augmentation()) == []
    options = {"joined_share": 0.5, "speed_share": 0.5, "bent_share": 0.5}
    first, second = (augmented(clips, Augmentation(**options)) for _ in range(2))
    assert [c.id for c in first] == [c.id for c in second]
    assert all(torch.equal(a.features, b.features) for a, b in zip(first, second, strict=True))
    assert len({clip.id for clip in first}) == len(first) == 9
    other = augmented(clips, Augmentation(**options, augmentation_seed=1))
    assert [c.id for c in other] != [c.id for c in first]


def test_large_bends_stay_as_wide_as_somebody_can_walk(walk):
    """A way of 5 m holds a circle of a metre's radius not quite once: 5 rad are 286 degrees."""
    features = joints_to_features(walk(101, turn=0.0, speed=0.05), public_quirks=False)
    clips = [FeatureClip("way", features, captions("a person walks"), "lab")]
    way = float(recover_joints(features[None], joints=22)[0, :, 0].diff(dim=0).norm(dim=-1).sum())
    for largest, most in ((75.0, 75.0), (360.0, math.degrees(way))):
        made = augmented(clips, Augmentation(bent_share=10, largest_bend=largest))
        degrees = [abs(float(clip.id.split("@")[1].split("~")[0])) for clip in made]
        assert len(degrees) == 10
        assert 25 <= min(degrees) <= max(degrees) <= most + 0.5
        assert max(degrees) > 0.8 * most


def test_clips_without_true_captions_are_not_made(clips):
    silent = [FeatureClip(c.id, c.features, captions("a man slowly turns left"), c.source) for c in clips]
    assert augmented(silent, Augmentation(speed_share=1.0, bent_share=1.0)) == []


def test_impossible_bends_are_refused():
    with pytest.raises(ValueError, match=r"`largest_bend` must be between 25 and 720 degrees, got 10"):
        Augmentation(largest_bend=10)


def test_impossible_shares_are_refused():
    with pytest.raises(ValueError, match=r"`bent_share` must be between 0 and 10, got -1"):
        Augmentation(bent_share=-1)
