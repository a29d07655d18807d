"""Timelines and chains: what passes hold, lengths, seeds, and what is refused."""

from __future__ import annotations

import dataclasses
import statistics

import pytest
import torch

from controlmm.controls import Avoid, JointControl, Sphere, TimelineEntry, penetration
from controlmm.generation.composition import TRANSITION
from controlmm.generation.editing import EditingBudget
from controlmm.generation.terms import ObstacleTerm
from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import HUMANML3D
from controlmm.pipelines import TLCONTROL_PRESETS, Preset
from controlmm.pipelines.pipeline import MotionPipeline

QUICK = Preset(EditingBudget(latent_iterations=3), steps=2)
EDITED = Preset(EditingBudget(latent_iterations=150), steps=2)
SOLVED = Preset(EditingBudget(solver="auto", latent_iterations=20), steps=2)
ENTRIES = [
    TimelineEntry("left_foot", "a person kicks", frames=(0, 16)),
    TimelineEntry("lower", "a person jumps", frames=(16, 40)),
    TimelineEntry("upper", "a person waves", frames=(0, 40)),
]
WALK_AND_WAVE = [
    TimelineEntry("lower", "a person walks", frames=(0, 60)),
    TimelineEntry("right_arm", "a person waves", frames=(20, 36)),
]
GOALS = [
    JointControl("pelvis", frames=[0, 59], positions=[[1, None, 2], [1, None, 4]]),
    JointControl("right_wrist", frames=[30], positions=[[1, 1.3, 3]]),
]


@pytest.fixture
def passes(tiny_pipeline, monkeypatch):
    """The arguments of every pass."""
    calls = []
    generate = type(tiny_pipeline).generate_latents

    def recorded(self, text, **options):
        calls.append({**options, "text": text})
        return generate(self, text, **options)

    monkeypatch.setattr(type(tiny_pipeline), "generate_latents", recorded)
    return calls


def held(call):
    """(frame, joint) pairs that a pass controls in all axes, as sets of frames by joint."""
    mask = call["mask"][0].all(-1)
    return {
        joint: set(mask[:, joint].nonzero()[:, 0].tolist()) for joint in range(22) if mask[:, joint].any()
    }


def test_each_pass_holds_exactly_what_earlier_entries_decided(tiny_pipeline, passes):
    """The published way. Source: MaskControl's demo; lower = 0, 10, 11."""
    result = tiny_pipeline.timeline(ENTRIES, preset=QUICK, method="published")
    first, second, third = map(held, passes)
    assert first == {}
    assert second == {10: set(range(16))}
    assert third == {0: set(range(16, 40)), 10: set(range(40)), 11: set(range(16, 40))}
    assert [call["lengths"] for call in passes] == [[16], [40], [40]]
    assert result.best.num_frames == 40
    assert result.best.extra["timeline"] == tuple(ENTRIES)


def test_the_rest_of_the_body_is_held_outside_an_entry_but_for_a_transition(tiny_pipeline, passes):
    entries = [
        TimelineEntry("lower", "a person walks", frames=(0, 40)),
        TimelineEntry("right_wrist", "a person waves", frames=(16, 28)),
    ]
    tiny_pipeline.timeline(entries, preset=QUICK, method="passes")
    outside = {*range(16 - TRANSITION), *range(28 + TRANSITION, 40)}
    assert held(passes[1]) == {joint: set(range(40)) for joint in (0, 10, 11)}  # what the networks see
    (rest,) = passes[1]["terms"]
    frames = held({"mask": rest.mask})
    assert all(frames.pop(joint) == outside for joint in set(range(22)) - {0, 10, 11})
    assert not frames


def test_frames_that_no_pass_has_made_yet_are_free(tiny_pipeline, passes):
    tiny_pipeline.timeline(ENTRIES[:2], preset=QUICK, method="passes")
    assert held(passes[1]) == {10: set(range(16))}
    (rest,) = passes[1]["terms"]
    assert rest.mask.any(2).any(2)[0].nonzero().max() == 16 - TRANSITION - 1


def test_pins_are_taken_from_the_newest_pass_and_held_by_editing(tiny_pipeline, passes):
    result = tiny_pipeline.timeline(ENTRIES, preset=EDITED, samples=2, method="passes")
    targets, mask = passes[2]["targets"], passes[2]["mask"]
    for motion, wanted, asked, error in zip(result, targets, mask, result.control_error, strict=True):
        distance = (motion.joints - wanted)[asked.all(-1)].norm(dim=-1).mean()
        assert error.item() == pytest.approx(distance.item(), rel=0.02)
        assert distance < 0.4  # 2 m without the editing of this tiny model


@pytest.mark.parametrize("method", ["passes", "tracks"])
def test_samples_of_a_timeline_do_not_depend_on_their_number(tiny_pipeline, method):
    options = {"preset": QUICK, "method": method}
    two, one = (tiny_pipeline.timeline(ENTRIES, samples=count, seed=4, **options) for count in (2, 1))
    torch.testing.assert_close(two[0].joints, one[0].joints, rtol=0, atol=1e-3)
    assert (two[0].joints - two[1].joints).abs().max() > 1e-3
    other = tiny_pipeline.timeline(ENTRIES, seed=5, **options)
    assert (other[0].joints - one[0].joints).abs().max() > 1e-3


def test_controls_and_obstacles_count_in_every_pass(tiny_pipeline, passes):
    start = JointControl("pelvis", frames=[0], positions=[[3, 0.9, 1]])
    moving = Avoid(Sphere([[3, 1, 2], [4, 1, 2]], 0.2), frames=[0, 39])
    result = tiny_pipeline.timeline(
        ENTRIES, controls=[start], obstacles=[moving], preset=QUICK, method="passes"
    )
    assert all(call["mask"][0, 0, 0].all() for call in passes)
    assert [sum(isinstance(term, ObstacleTerm) for term in call["terms"]) for call in passes] == [1, 1, 1]
    torch.testing.assert_close(passes[0]["targets"][0, 0, 0], torch.tensor([0.0, 0.9, 0.0]))
    assert (result.best.joints[0, 0, [0, 2]] - torch.tensor([3.0, 1.0])).norm() < 0.2
    assert result.best.extra["obstacles"] == (moving,)


def test_tracks_are_made_apart_and_see_the_controls_of_their_joints(tiny_pipeline, passes):
    result = tiny_pipeline.timeline(WALK_AND_WAVE, controls=GOALS, preset=SOLVED, samples=2, seed=1)
    (call,) = passes
    assert call["lengths"] == [60, 60, 26, 26]  # the wave with a transition on either side
    assert torch.equal(call["text"][0], call["text"][1])
    assert not torch.equal(call["text"][1], call["text"][2])
    assert [sorted(set(clip.nonzero()[:, 1].tolist())) for clip in call["mask"]] == [[0], [0], [], []]
    torch.testing.assert_close(call["targets"][0, 59, 0], torch.tensor([0.0, 0.0, 2.0]))
    assert result.best.num_frames == 60
    assert result.best.extra["timeline"] == tuple(WALK_AND_WAVE)


def test_tracks_come_nearer_to_the_targets_than_without_them(tiny_pipeline):
    """An untrained model has steps to hold that lead elsewhere, in some samples far: so the median."""
    led = tiny_pipeline.timeline(WALK_AND_WAVE, controls=GOALS, preset=SOLVED, samples=8, seed=1)
    blind = tiny_pipeline.timeline(WALK_AND_WAVE, preset=SOLVED, samples=8, seed=1)
    for frame, joint, place in ((59, 0, [1.0, 0.0, 4.0]), (30, 21, [1.0, 1.3, 3.0])):
        off = [
            statistics.median(
                (m.joints[frame, joint] - torch.tensor(place))[[0, 2]].norm().item() for m in motions
            )
            for motions in (led, blind)
        ]
        assert off[0] < 0.7 * off[1]


def test_obstacles_are_avoided_by_what_tracks_make(tiny_pipeline):
    """A ball where the head is in a frame: there it leaves. The median over seeds, for the same reason."""
    apart = []
    for seed in range(5):
        free = tiny_pipeline.timeline(ENTRIES, preset=EDITED, seed=seed).best
        place = free.joints[20, 15] + torch.tensor([0.1, 0.0, 0.0])
        ball = Avoid(Sphere(place.tolist(), 0.2))
        result = tiny_pipeline.timeline(ENTRIES, obstacles=[ball], preset=EDITED, seed=seed)
        apart.append((result.best.joints[20, 15] - place).norm().item())
        assert result.penetration.item() == pytest.approx(
            penetration(result.best.joints[None], [ball], HUMANML3D).item(), rel=1e-4
        )
    assert statistics.median(apart) > 0.2, apart


def test_tracks_work_with_tlcontrol(tiny_tlcontrol):
    plan = dataclasses.replace(TLCONTROL_PRESETS["fast"], iterations=2)
    result = tiny_tlcontrol.timeline(ENTRIES, preset=plan)
    assert result.best.num_frames == 40
    assert torch.isfinite(result.best.joints).all()


def test_a_timeline_may_be_longer_than_a_call(tiny_pipeline):
    entries = [TimelineEntry("body", "a person walks", frames=(0, 240))]
    assert tiny_pipeline.longest >= 240
    assert tiny_pipeline.timeline(entries, preset=QUICK).best.num_frames == 240


def test_what_a_timeline_cannot_do_is_refused_before_anything_runs(tiny_pipeline, monkeypatch):
    def never(*args, **kwargs):
        raise AssertionError("a network ran")

    monkeypatch.setattr(type(tiny_pipeline), "generate_latents", never)
    too_long = [TimelineEntry("body", "a person walks", frames=(0, tiny_pipeline.longest + 8))]
    with pytest.raises(ValueError, match=r"The timeline ends at frame 400 \(20 s\), .* at most 392 frames"):
        tiny_pipeline.timeline(too_long)
    with pytest.raises(
        ValueError, match=r"`method` must be one of .'tracks', 'passes', 'published'., got 'x'"
    ):
        tiny_pipeline.timeline(ENTRIES, method="x")
    with pytest.raises(ValueError, match=r"`preset` 'exact' makes single motions"):
        tiny_pipeline.timeline(ENTRIES, preset="exact")
    with pytest.raises(ValueError, match=r"`entries` is empty"):
        tiny_pipeline.timeline([])
    with pytest.raises(ValueError, match=r"names frame 50, but the clip has 40 frames"):
        tiny_pipeline.timeline(ENTRIES, controls=[JointControl("head", [50], [[0, 1, 0]])])


def test_a_timeline_survives_npz_and_is_drawn(tiny_pipeline, tmp_path):
    motion = tiny_pipeline.timeline(ENTRIES, preset=QUICK).best
    again = Motion.load(motion.save(tmp_path / "a.npz"))
    assert again.extra["timeline"] == tuple(ENTRIES)
    with_tracks = again.save(tmp_path / "a.png", dpi=40).read_bytes()
    plain = dataclasses.replace(again, extra={}).save(tmp_path / "b.png", dpi=40).read_bytes()
    assert with_tracks != plain


CLIPS = [("a person walks", 2.0), ("a person jumps", 2.4), ("a person sits", 2.0)]


def test_a_chain_has_all_its_clips_and_no_jump_where_they_meet(tiny_pipeline, passes):
    result = tiny_pipeline.chain(CLIPS, overlap=0.4, preset=EDITED, samples=2)
    assert [call["lengths"][0] for call in passes] == [40, 48, 40]
    assert all(motion.num_frames == 40 + 48 + 40 - 2 * 8 for motion in result)
    assert held(passes[0]) == {}
    assert held(passes[1]) == {joint: set(range(8)) for joint in range(22)}
    assert (result.control_error > 0).all()
    steps = result[0].joints.diff(dim=0).norm(dim=-1).mean(1)
    assert steps[28:44].max() < 2 * steps.max()
    assert torch.isfinite(result[0].joints).all()


def test_the_poses_that_a_clip_must_begin_with_are_those_before_seen_from_its_own_frame(
    tiny_pipeline, passes
):
    """A turn and a shift bring the targets of the second clip onto the end of the first."""
    result = tiny_pipeline.chain(CLIPS[:1], preset=QUICK)
    end = result.best.joints[-8:]
    passes.clear()
    tiny_pipeline.chain(CLIPS[:2], overlap=0.4, preset=QUICK)
    targets = passes[1]["targets"][0, :8]
    assert targets[0, 0, [0, 2]].abs().max() < 1e-5
    for a, b in ((0, 15), (3, 20), (1, 8)):  # distances are free of the frame
        torch.testing.assert_close(
            (targets[:, a] - targets[:, b]).norm(dim=-1),
            (end[:, a] - end[:, b]).norm(dim=-1),
            rtol=0,
            atol=1e-4,
        )


@pytest.mark.parametrize(
    ("clips", "overlap", "message"),
    [
        ([], 0.8, r"`clips` must be a list of \(prompt, seconds\)"),
        (["walk"], 0.8, r"`clips\[0\]` must be \(prompt, seconds\), got 'walk'"),
        ([("walk", 20.0)], 0.8, r"`seconds` must be between 0\.4 and 9\.8"),
        ([("walk", 1.6)], 0.8, r"`clips\[0\]` must last more than twice the overlap of 0\.8 s, got 1\.6 s"),
        (CLIPS, 0.2, r"`overlap` must be at least 0\.4 s, got 0\.2"),
    ],
)
def test_impossible_chains_are_refused(tiny_pipeline, clips, overlap, message):
    with pytest.raises(ValueError, match=message):
        tiny_pipeline.chain(clips, overlap=overlap)


def test_the_abstract_pipeline_offers_all_of_it():
    assert {"timeline", "chain", "longest"} <= set(dir(MotionPipeline))
