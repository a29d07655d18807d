"""Batches that pipelines work on in shares: the same to the bit as by one thread; and what is never split."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch

from controlmm import JointControl
from controlmm.controls import Objective, Sphere, TimelineEntry
from controlmm.generation.noise import clip_seeds
from controlmm.generation.shares import in_shares
from controlmm.pipelines import PRESETS, Preset
from controlmm.pipelines.clip_batch import ClipBatch

PROMPT = "a person walks forward"
WRIST = JointControl("right_wrist", frames=[10, 20], positions=[[0.2, 1.0, 0.3], [0.4, 1.0, 0.6]])
BALL = Sphere((-0.2, 0.9, 0.5), 0.2)
EARLY_WRIST = JointControl("right_wrist", frames=[10], positions=[[0.2, 1.0, 0.3]])
STEPS, ITERATIONS = 3, 8  # of decoding and of editing: enough that clips end apart
PLANS = {
    name: replace(plan, steps=STEPS, budget=replace(plan.budget, latent_iterations=ITERATIONS))
    for name, plan in PRESETS.items()
}


@pytest.fixture(autouse=True)
def _threads_as_before() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def share_sizes(monkeypatch) -> list[int]:
    """Clips of every share that is worked on."""
    sizes: list[int] = []
    latents = ClipBatch.latents

    def noted(batch: ClipBatch, *args: Any) -> torch.Tensor:
        sizes.append(len(batch.seeds))
        return latents(batch, *args)

    monkeypatch.setattr(ClipBatch, "latents", noted)
    return sizes


def by_threads(count: int, call: Any) -> Any:
    torch.set_num_threads(count)
    result = call()
    assert torch.get_num_threads() == count
    return result


def assert_equal(one: Any, other: Any) -> None:
    assert torch.equal(one.latents, other.latents)
    assert torch.equal(one.control_error, other.control_error)
    assert one.exact == other.exact
    for motion, twin in zip(one, other, strict=True):
        assert torch.equal(motion.joints, twin.joints)
        assert torch.equal(motion.features, twin.features)


@pytest.mark.parametrize(
    ("preset", "scene"),
    [
        ("accurate", {"controls": [WRIST]}),
        ("exact", {"controls": [WRIST]}),
        ("paper-fast", {"controls": [WRIST]}),
        ("balanced", {"controls": [WRIST], "obstacles": [BALL]}),
        ("balanced", {"obstacles": [BALL]}),
        ("balanced", {}),
    ],
)
def test_samples_are_the_same_by_any_number_of_threads(tiny_pipeline, share_sizes, preset, scene):
    def call():
        return tiny_pipeline(PROMPT, frames=24, samples=4, seed=3, preset=PLANS[preset], **scene)

    one = by_threads(1, call)
    assert share_sizes == [4]
    for count, sizes in ((2, [2, 2]), (3, [1, 1, 2])):
        share_sizes.clear()
        assert_equal(one, by_threads(count, call))
        assert sorted(share_sizes) == sizes


def test_a_mixed_batch_is_the_same_by_any_number_of_threads(tiny_pipeline, share_sizes):
    """Clips with and without targets, of several lengths; a fresh pipeline fills its caches by threads."""
    generator = torch.Generator().manual_seed(1)
    lengths = [48, 8, 33, 48, 12, 20, 48]
    targets, mask = (
        torch.randn(7, 48, 22, 3, generator=generator),
        torch.zeros(7, 48, 22, 3, dtype=torch.bool),
    )
    for clip, joint in ((0, 0), (1, 20), (3, 15), (5, 0)):
        mask[clip, 1 : lengths[clip] : 3, joint] = True
    batch = {"lengths": lengths, "targets": targets, "mask": mask, "seeds": list(range(7))}
    text = torch.randn(7, 64, generator=generator)
    plan = tiny_pipeline.resolve_preset(PLANS["accurate"], None)
    by_two, by_three, by_one = (
        by_threads(count, lambda: tiny_pipeline.generate_latents(text, preset=plan, **batch))
        for count in (2, 3, 1)
    )
    assert len(share_sizes) == 2 + 3 + 1
    assert torch.equal(by_two, by_one)
    assert torch.equal(by_three, by_one)


def test_tracks_of_a_timeline_are_the_same_by_any_number_of_threads(tiny_pipeline, share_sizes):
    entries = [
        TimelineEntry("lower", "walks", frames=(0, 24)),
        TimelineEntry("upper", "waves", frames=(4, 24)),
    ]

    def call():
        return tiny_pipeline.timeline(entries, samples=2, preset=PLANS["fast"])

    one = by_threads(1, call)
    assert_equal(one, by_threads(2, call))
    assert sorted(share_sizes[1:]) == [2, 2]


@pytest.mark.parametrize("options", [{"keep": [(0.0, 0.6)]}, {"keep_parts": ["lower"], "exact": True}, {}])
def test_edits_are_the_same_by_any_number_of_threads(tiny_pipeline, monkeypatch, options):
    threads = []

    def noted(*args: Any, **kwargs: Any) -> torch.Tensor:
        threads.append(kwargs["threads"])
        return in_shares(*args, **kwargs)

    monkeypatch.setattr("controlmm.pipelines.motion_editing.in_shares", noted)
    source = tiny_pipeline(PROMPT, frames=24, preset=PLANS["fast"]).best

    def call():
        return tiny_pipeline.edit(source, "a person sits", samples=3, preset=PLANS["fast"], **options)

    assert_equal(by_threads(1, call), by_threads(2, call))
    assert threads == [1, 2]


def test_what_is_for_the_whole_batch_is_not_split(tiny_pipeline, share_sizes):
    def calm(joints):
        assert threading.current_thread() is threading.main_thread()
        return joints.diff(dim=-3).square().sum((-1, -2, -3))

    call = {"frames": 16, "preset": PLANS["fast"], "controls": [EARLY_WRIST]}
    torch.set_num_threads(2)
    tiny_pipeline(PROMPT, samples=1, **call)
    tiny_pipeline(PROMPT, samples=2, time_budget="50ms", **call)
    tiny_pipeline(PROMPT, samples=2, objectives=[Objective(calm)], **call)
    assert share_sizes == [1, 2, 2]
    tiny_pipeline(PROMPT, samples=2, **call)
    assert share_sizes[3:] == [1, 1]


def test_progress_of_shares_reads_like_that_of_one_batch(tiny_pipeline):
    calls = []

    def note(*call: Any) -> None:
        assert threading.current_thread() is threading.main_thread()
        assert torch.get_num_threads() == 1
        calls.append(call)

    plan: Preset = PLANS["paper-fast"]
    torch.set_num_threads(3)
    tiny_pipeline(PROMPT, frames=24, samples=4, controls=[WRIST], preset=plan, progress=note)
    phases = [("masked decoding", STEPS), ("codebook editing", ITERATIONS)]
    shown = {phase: [call for call in calls if call[0] == phase] for phase, _ in phases}
    assert calls == [call for phase, _ in phases for call in shown[phase]]
    for phase, total in phases:
        done = [call[1] for call in shown[phase]]
        assert done == sorted(set(done))
        assert done[-1] == total
        assert {call[2] for call in shown[phase]} == {total}


def test_an_error_in_one_share_reaches_the_caller_and_the_next_call_works(tiny_pipeline, monkeypatch):
    latents, running = ClipBatch.latents, threading.active_count()

    def fails(batch: ClipBatch, *args: Any) -> torch.Tensor:
        if seeds[1] in batch.seeds:
            raise ArithmeticError("no way")
        return latents(batch, *args)

    seeds = clip_seeds(7, 2)
    call = {"frames": 24, "samples": 2, "seed": 7, "controls": [WRIST], "preset": PLANS["accurate"]}
    torch.set_num_threads(2)
    with monkeypatch.context() as patch:
        patch.setattr(ClipBatch, "latents", fails)
        with pytest.raises(ArithmeticError, match="no way"):
            tiny_pipeline(PROMPT, **call)
    assert threading.active_count() == running
    assert torch.get_num_threads() == 2
    after = tiny_pipeline(PROMPT, **call)
    assert_equal(by_threads(1, lambda: tiny_pipeline(PROMPT, **call)), after)
