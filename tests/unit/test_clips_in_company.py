"""A clip is the same, to the bit, alone and in any batch, at any place, with any number of threads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
import torch

from controlmm import ControlMM, JointControl
from controlmm.generation.clip_sums import clip_sums
from controlmm.generation.editing import EditingBudget
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.one_thread import one_thread
from controlmm.generation.sensitivity import Sensitivity
from controlmm.models.rvq_vae import frame_mask
from controlmm.ops import recover_joints
from controlmm.pipelines import PRESETS, Preset

LENGTHS = (48, 8, 33, 48)  # frames: one clip of two tokens, two clips that networks take together
JOINTS = ((0,), (0, 20), (21,), (0, 10, 15))
STEPS = 8  # of editing at most
ROUNDING = 1e-6  # of float32 sums of numbers of order one

LOGITS = Preset(EditingBudget(logits_iterations=3, latent_iterations=3))  # as `paper-accurate`, but short
LBFGS = Preset(EditingBudget(solver="lbfgs", latent_iterations=20, naturalness=1.0))
PLANS = {
    **{name: PRESETS[name] for name in ("fast", "accurate", "paper-fast")},
    "logits": LOGITS,
    "lbfgs": LBFGS,
}


@contextmanager
def threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@pytest.fixture
def two_threads() -> Iterator[None]:
    with threads(2):
        yield


def latents_of(pipeline: ControlMM, clips: list[int], plan: Preset, *, is_free: bool) -> list[torch.Tensor]:
    """Latents of some of the clips, generated together, without padding."""
    generator = torch.Generator().manual_seed(0)
    targets, texts = torch.randn(4, 48, 22, 3, generator=generator), torch.randn(4, 64, generator=generator)
    mask = torch.zeros(4, 48, 22, 3, dtype=torch.bool)
    for clip, joints in enumerate(JOINTS):
        mask[clip, 1 : LENGTHS[clip] : clip + 1, list(joints)] = not is_free
    lengths = [LENGTHS[clip] for clip in clips]
    longest = max(lengths)
    latents = pipeline.generate_latents(
        texts[clips],
        lengths=lengths,
        targets=targets[clips, :longest],
        mask=mask[clips, :longest],
        seeds=clips,
        preset=pipeline.resolve_preset(plan, None),
    )
    return [clip[: -(-length // 4)] for clip, length in zip(latents, lengths, strict=True)]


def assert_in_company(pipeline: ControlMM, plan: Preset, *, is_free: bool = False) -> None:
    plan = replace(plan, steps=2)
    if plan.budget.latent_iterations > STEPS:
        plan = replace(plan, budget=replace(plan.budget, latent_iterations=STEPS))
    together = latents_of(pipeline, [0, 1, 2, 3], plan, is_free=is_free)
    for clips, cores in [([3, 2, 1], 1), ([0], 1), ([1], 1), ([2], 1), ([0], 2)]:
        with threads(cores):
            others = latents_of(pipeline, clips, plan, is_free=is_free)
        for clip, latents in zip(clips, others, strict=True):
            assert torch.equal(latents, together[clip])


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("name", PLANS)
def test_edited_clips(tiny_pipeline, name):
    assert_in_company(tiny_pipeline, PLANS[name])


@pytest.mark.usefixtures("two_threads")
def test_edited_clips_whose_ends_are_repeated(tiny_pipeline):
    tiny_pipeline.decoder.tokenizer.decoder.ends = "repeat"
    assert_in_company(tiny_pipeline, PRESETS["accurate"])


@pytest.mark.usefixtures("two_threads")
def test_clips_from_text_whose_feet_are_planted(tiny_pipeline):
    assert_in_company(tiny_pipeline, PRESETS["balanced"], is_free=True)


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("preset", ["balanced", "exact"])
def test_motions_of_a_call(tiny_pipeline, preset):
    """Features and joints of a sample, however many there are; `exact` moves each clip by itself."""
    goal = JointControl("right_wrist", frames=[10, 20], positions=[[0.2, 1.0, 0.3], [0.4, 1.0, 0.6]])
    call = {"frames": 24, "controls": [goal], "preset": preset, "seed": 3}
    many = tiny_pipeline("a person waves", samples=2, **call)
    with threads(1):
        one = tiny_pipeline("a person waves", samples=1, **call)
    assert torch.equal(one.latents[0], many.latents[0])
    assert torch.equal(one.motions[0].joints, many.motions[0].joints)
    assert torch.equal(one.motions[0].features, many.motions[0].features)


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("ends", ["zeros", "repeat"])
def test_decoded_clips(tiny_pipeline, ends):
    decoder: MotionDecoder = tiny_pipeline.decoder
    decoder.tokenizer.decoder.ends = ends
    latents = torch.randn(3, 12, 16, generator=torch.Generator().manual_seed(1))
    frames = frame_mask(torch.tensor([48, 8, 28]), 48)
    together = decoder.clip_features(latents, frames)
    expected = decoder.features(latents, frames)
    torch.testing.assert_close(together, expected, rtol=ROUNDING, atol=20 * ROUNDING)
    for clip, length in enumerate([48, 8, 28]):
        with threads(1):
            alone = decoder.clip_features(latents[clip : clip + 1, : length // 4])
        assert torch.equal(alone[0], together[clip, :length])
        joints = recover_joints(together, joints=22)[clip, :length]
        assert torch.equal(recover_joints(alone, joints=22)[0], joints)


def test_sums_of_clips_know_no_padding():
    values = torch.randn(3, 50, 7, generator=torch.Generator().manual_seed(2))
    sums = clip_sums(values)
    torch.testing.assert_close(sums, values.double().sum((1, 2)).float(), rtol=ROUNDING, atol=ROUNDING)
    for padding in (1, 13, 150):
        assert torch.equal(clip_sums(torch.nn.functional.pad(values, (0, 0, 0, padding))), sums)
    assert torch.equal(clip_sums(values[1:2]), sums[1:2])
    assert torch.equal(clip_sums(values[:, :0]), torch.zeros(3))


def test_gradients_of_sums_are_those_of_sums():
    values = torch.randn(2, 9, 4, generator=torch.Generator().manual_seed(2)).requires_grad_()
    (gradient,) = torch.autograd.grad(clip_sums(values**2).sum(), values)
    assert torch.equal(gradient, 2 * values.detach())


@pytest.mark.usefixtures("two_threads")
def test_one_thread_lasts_as_long_as_it_is_wanted():
    with one_thread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2
    with pytest.raises(ZeroDivisionError), one_thread():
        _ = 1 / 0
    assert torch.get_num_threads() == 2


@pytest.mark.usefixtures("two_threads")
def test_products_of_channels_do_not_depend_on_the_channels_beside_them():
    """Sums of whole numbers are exact in any order; they say the same as the rows themselves to 2^-20."""
    generator = torch.Generator().manual_seed(4)
    channels = [
        Sensitivity(torch.randn(1, 4, 25, 48, generator=generator), torch.zeros(1, 4)) for _ in range(9)
    ]
    whole = Sensitivity.joined(channels).gram(12)
    with threads(1):
        part = Sensitivity.joined([channels[1], channels[6]]).gram(5)
    assert torch.equal(part, whole[[1, 6], :20][:, :, [1, 6], :20])
    row = channels[6].mean[0, 2]
    torch.testing.assert_close(whole[6, 2, 6, 2], row.square().sum(), rtol=ROUNDING, atol=0)
