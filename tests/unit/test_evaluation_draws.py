"""Test items, crops and controls by the rules of the public loaders."""

from __future__ import annotations

import itertools
from collections import Counter

import pytest
import torch

from controlmm.data import Caption, FeatureClip
from controlmm.evaluation.control_draws import (
    DENSITIES,
    ControlSetting,
    combinations,
    draw_frames,
    draw_joints,
    draw_mask,
)
from controlmm.evaluation.random_streams import stream
from controlmm.evaluation.test_set import SCORED_KINDS, Item, TestSet, items_of, sample_of
from controlmm.motion.skeleton import HUMANML3D, KIT

DRAWS = 600
SHARE = (
    0.07  # how far the share of a seeded draw may be from its probability, three deviations of DRAWS draws
)


def _clip(frames: int, *captions: Caption, width: int = 263) -> FeatureClip:
    features = torch.arange(frames, dtype=torch.float32)[:, None].expand(-1, width)
    return FeatureClip("000021", features, captions or (Caption("walks"),), "x")


@pytest.mark.parametrize(
    ("frames", "width", "is_kept"),
    [
        (39, 263, False),
        (40, 263, True),
        (199, 263, True),
        (200, 263, False),
        (23, 251, False),
        (24, 251, True),
    ],
)
def test_clips_that_are_too_short_or_too_long_are_left_out(frames: int, width: int, is_kept: bool) -> None:
    assert bool(list(items_of(_clip(frames, width=width), SCORED_KINDS))) is is_kept


def test_captions_of_the_whole_clip_are_one_item_and_each_part_its_own() -> None:
    clip = _clip(
        150,
        Caption("walks"),
        Caption("strolls"),
        Caption("turns", start=1.0, end=3.49),
        Caption("hops", end=1.0),
    )
    items = list(items_of(clip, SCORED_KINDS))
    assert [item.id for item in items] == ["000021", "000021@2"]  # one second is too short
    assert [caption.text for caption in items[0].captions] == ["walks", "strolls"]
    assert items[1].features[:, 0].tolist() == list(range(20, 69))  # int(3.49 * 20) = 69


def test_a_clip_whose_captions_all_speak_of_parts_gives_parts_only() -> None:
    (item,) = items_of(_clip(150, Caption("turns", start=0.0, end=5.0)), SCORED_KINDS)
    assert len(item.features) == 100


def test_templates_are_not_scored() -> None:
    clip = _clip(60, Caption("a", "template"), Caption("b", "written"), Caption("c", "description"))
    (item,) = items_of(clip, SCORED_KINDS)
    assert [caption.text for caption in item.captions] == ["b"]


@pytest.mark.parametrize(("frames", "long", "short"), [(40, 40, 36), (71, 68, 64), (199, 196, 192)])
def test_a_crop_has_whole_tokens_and_loses_one_more_in_a_third_of_the_cases(
    frames: int, long: int, short: int
) -> None:
    item = Item("a", _clip(frames).features, (Caption("one"), Caption("two")), "x")
    samples = [sample_of(item, stream(0, index)) for index in range(DRAWS)]
    lengths = Counter(sample.length for sample in samples)
    assert set(lengths) == {long, short}
    assert lengths[short] / DRAWS == pytest.approx(1 / 3, abs=SHARE)
    starts = {int(sample.features[0, 0]) for sample in samples if sample.length == short}
    assert starts == set(range(frames - short + 1))
    captions = Counter(sample.caption.text for sample in samples)
    assert captions["one"] / DRAWS == pytest.approx(1 / 2, abs=SHARE)


def _test_set(count: int) -> TestSet:
    features = torch.zeros(60, 263)
    items = tuple(Item(f"{i}", features, (Caption("a"), Caption("b")), "x") for i in range(count))
    return TestSet(items, "test", SCORED_KINDS)


def test_a_samples_draws_do_not_depend_on_the_other_clips() -> None:
    many = {sample.id: sample for sample in _test_set(50).samples(seed=3, repeat=1)}
    for sample in _test_set(7).samples(seed=3, repeat=1):
        assert (sample.length, sample.caption) == (many[sample.id].length, many[sample.id].caption)


def test_repeats_differ_in_order_and_draws() -> None:
    first, again, second = (
        [(s.id, s.length, s.caption.text) for s in _test_set(50).samples(seed=0, repeat=repeat)]
        for repeat in (0, 0, 1)
    )
    assert first == again
    assert [name for name, *_ in first] != [name for name, *_ in second]
    assert sorted(first) != sorted(second)


def test_the_63_combinations_come_by_size_then_in_order() -> None:
    found = combinations(HUMANML3D)
    assert len(set(found)) == 63
    assert found[:8] == [(0,), (10,), (11,), (15,), (20,), (21,), (0, 10), (0, 11)]
    assert found[-1] == (0, 10, 11, 15, 20, 21)
    assert all(len(a) <= len(b) for a, b in itertools.pairwise(found))


def test_cross_draws_a_combination_for_each_sample_all_alike() -> None:
    drawn = Counter(draw_joints("cross", HUMANML3D, stream(0, index)) for index in range(3000))
    assert set(drawn) == set(combinations(HUMANML3D))
    assert max(drawn.values()) < 3 * min(drawn.values())  # 48 each on average


@pytest.mark.parametrize(
    ("control", "skeleton", "joints"),
    [
        ("pelvis", HUMANML3D, (0,)),
        ("head", HUMANML3D, (15,)),
        ("left_elbow", HUMANML3D, (18,)),
        ("lower", HUMANML3D, (0, 10, 11)),
        ("all", HUMANML3D, (0, 10, 11, 15, 20, 21)),
        ("none", HUMANML3D, ()),
        ("pelvis", KIT, (0,)),
        ("all", KIT, (0, 4, 7, 10, 15, 20)),
    ],
)
def test_joints_of_a_control(control: str, skeleton: object, joints: tuple[int, ...]) -> None:
    assert draw_joints(control, skeleton, stream(0)) == joints


def test_random_draws_one_of_the_six() -> None:
    drawn = {draw_joints("random", HUMANML3D, stream(0, index)) for index in range(100)}
    assert drawn == {(joint,) for joint in HUMANML3D.control_joints}


@pytest.mark.parametrize(
    ("density", "length", "count"), [(1, 36, 1), (5, 36, 5), (49, 71, 17), (196, 71, 71)]
)
def test_keyframes_are_distinct_and_as_many_as_the_density_says(
    density: int, length: int, count: int
) -> None:
    frames = draw_frames(density, length, stream(1))
    assert len(frames) == len(frames.unique()) == count
    assert 0 <= int(frames.min()) <= int(frames.max()) < length


def test_every_density_is_drawn_for_each_sample() -> None:
    drawn = Counter(len(draw_frames("all", 196, stream(0, index))) for index in range(DRAWS))
    assert set(drawn) == set(DENSITIES)
    assert all(count / DRAWS == pytest.approx(1 / 5, abs=SHARE) for count in drawn.values())


def test_all_joints_of_a_sample_share_their_frames() -> None:
    mask = draw_mask(ControlSetting("lower", 5), 40, HUMANML3D, frames=196, generator=stream(2))
    assert mask.shape == (196, 22)
    assert mask.sum() == 15
    assert torch.equal(mask[:, 0], mask[:, 10])
    assert torch.equal(mask[:, 0], mask[:, 11])
    assert not mask[40:].any()


def test_unknown_settings_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"`control` must be a joint .* or one of random, cross, lower, all, none"
    ):
        ControlSetting("tail").check(HUMANML3D)
    with pytest.raises(ValueError, match="`density` must be one of 1, 2, 5, 49, 196 or all, got 7"):
        ControlSetting("pelvis", 7).check(HUMANML3D)
