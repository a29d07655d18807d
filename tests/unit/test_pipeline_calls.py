"""What the public call returns: seeds, batches, lengths, controls, placement."""

from __future__ import annotations

import math

import pytest
import torch

from controlmm.controls import JointControl, PathControl
from controlmm.generation.editing import EditingBudget
from controlmm.generation.noise import clip_seeds
from controlmm.models.control_branch import ControlBranch
from controlmm.motion.motion import Motion
from controlmm.ops import recover_joints
from controlmm.pipelines import Preset

PROMPT = "a person walks forward"
QUICK = Preset(EditingBudget(logits_iterations=1, latent_iterations=5), steps=3)
# A batch of another size sums in another order; the root path of up to 196 frames adds that up.
SAME_MOTION = 1e-4  # metres
WRIST = JointControl("right_wrist", frames=[3, 12], positions=[[-0.3, 1.2, 0.2], [-0.2, 1.4, 0.5]])


def joints(result) -> torch.Tensor:
    return torch.stack([motion.joints for motion in result])


@pytest.mark.parametrize("controls", [[], [WRIST]], ids=["text", "control"])
def test_the_same_seed_gives_the_same_motion_and_another_seed_another(tiny_pipeline, controls):
    first, again, other = (
        joints(tiny_pipeline(PROMPT, frames=24, controls=controls, preset=QUICK, seed=seed))
        for seed in (3, 3, 4)
    )
    assert torch.equal(first, again)
    assert (first - other).abs().max() > 1e-3


@pytest.mark.parametrize("controls", [[], [WRIST]], ids=["text", "control"])
def test_a_call_neither_uses_nor_changes_the_global_random_state(tiny_pipeline, controls):
    results = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        before = torch.get_rng_state()
        results.append(joints(tiny_pipeline(PROMPT, frames=16, controls=controls, preset=QUICK)))
        assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(*results)


@pytest.mark.parametrize("controls", [[], [WRIST]], ids=["text", "control"])
def test_a_sample_does_not_depend_on_how_many_are_asked_for(tiny_pipeline, controls):
    options = {"frames": 40, "controls": controls, "preset": QUICK, "seed": 2}
    many, few = (joints(tiny_pipeline(PROMPT, samples=count, **options)) for count in (3, 1))
    torch.testing.assert_close(many[:1], few, rtol=0, atol=SAME_MOTION)
    assert (many[0] - many[1]).abs().max() > 1e-3


@pytest.mark.parametrize("frames", [8, 16, 40, 41, 80, 195, 196])
def test_motions_have_the_length_that_was_asked_for(tiny_pipeline, frames):
    control = JointControl("head", frames=[frames - 1], positions=[[0.1, 1.5, 0.4]])
    plan = Preset(EditingBudget(latent_iterations=2), steps=2)
    for controls in ([], [control]):
        (motion,) = tiny_pipeline(PROMPT, frames=frames, controls=controls, preset=plan)
        assert motion.joints.shape == (frames, 22, 3)
        assert motion.features.shape == (frames, 263)
        assert torch.isfinite(motion.joints).all()


@pytest.mark.parametrize(("seconds", "frames"), [(0.4, 8), (2, 40), (2.06, 41), (9.8, 196), (None, 120)])
def test_seconds_are_counted_at_twenty_frames(tiny_pipeline, seconds, frames):
    plan = Preset(EditingBudget(), steps=1)
    assert tiny_pipeline(PROMPT, seconds=seconds, preset=plan).best.num_frames == frames


def test_joints_are_the_decoded_features_and_latents_decode_to_them(tiny_pipeline):
    result = tiny_pipeline(PROMPT, frames=18, controls=[WRIST], preset=QUICK, samples=2)
    for motion, latents in zip(result, result.latents, strict=True):
        torch.testing.assert_close(recover_joints(motion.features[None])[0], motion.joints)
        decoded = tiny_pipeline.decoder(latents[None])[0, :18]
        torch.testing.assert_close(decoded, motion.joints, rtol=0, atol=SAME_MOTION)


def batch(pipeline, prompts, lengths, seeds, targets, mask):
    text = pipeline.text_encoder.encode(prompts).pooled
    return pipeline.generate_latents(
        text, lengths=lengths, targets=targets, mask=mask, seeds=seeds, preset=QUICK
    )


def test_clips_of_a_mixed_batch_equal_the_clips_alone(tiny_pipeline):
    """Three lengths, two with targets and one without, three prompts."""
    prompts, lengths, seeds = ["walk", "wave both hands", "sit down"], [40, 17, 28], clip_seeds(1, 3)
    targets = torch.rand(3, 40, 22, 3, generator=torch.Generator().manual_seed(0))
    mask = torch.zeros(3, 40, 22, 3, dtype=torch.bool)
    mask[0, [5, 39], 21] = True
    mask[1, 16, 0] = True
    together = batch(tiny_pipeline, prompts, lengths, seeds, targets, mask)
    for clip, length in enumerate(lengths):
        rows = slice(clip, clip + 1)
        cut = (targets[rows, :length], mask[rows, :length])
        alone = batch(tiny_pipeline, prompts[rows], [length], seeds[rows], *cut)
        tokens = alone.shape[1]
        torch.testing.assert_close(together[rows, :tokens], alone, rtol=0, atol=1e-3)  # 5 Adam steps of 0.06
        assert together[clip, tokens:].abs().sum() == 0


def test_targets_after_the_end_of_a_clip_are_refused(tiny_pipeline):
    mask = torch.zeros(2, 40, 22, 3, dtype=torch.bool)
    mask[1, 30] = True
    with pytest.raises(ValueError, match="`mask` controls frame 30 of clip 1, which has 28 frames"):
        batch(tiny_pipeline, ["walk", "wave"], [40, 28], [1, 2], torch.zeros(2, 40, 22, 3), mask)


def test_editing_lowers_the_control_error(tiny_pipeline):
    errors = []
    for iterations in (0, 60):
        plan = Preset(EditingBudget(latent_iterations=iterations), steps=4)
        result = tiny_pipeline(PROMPT, frames=40, controls=[WRIST], samples=3, preset=plan)
        errors.append(result.control_error.mean())
    assert errors[1] < 0.7 * errors[0]


def test_logits_editing_takes_part_in_every_decoding_step(tiny_pipeline, monkeypatch):
    from controlmm.generation import logits_editing

    iterations = []
    edit = logits_editing.edit_logits

    def counted(*args, **options):
        iterations.append(options["iterations"])
        return edit(*args, **options)

    monkeypatch.setattr(logits_editing, "edit_logits", counted)
    plan = Preset(EditingBudget(logits_iterations=2, latent_iterations=0), steps=4)
    tiny_pipeline(PROMPT, frames=16, controls=[WRIST], preset=plan)
    assert iterations == [2, 2, 2, 2]


def test_control_error_is_that_of_the_motions_returned(tiny_pipeline):
    result = tiny_pipeline(PROMPT, frames=24, controls=[WRIST], preset=QUICK, samples=2)
    for motion, error in zip(result, result.control_error, strict=True):
        distance = (motion.joints[WRIST.frames, 21] - WRIST.positions).norm(dim=-1).mean()
        torch.testing.assert_close(error, distance)
    assert result.best is result[int(result.control_error.argmin())]
    assert len(result) == 2


def test_without_controls_the_error_is_zero_and_the_control_branch_is_off(tiny_pipeline, monkeypatch):
    def never(*args, **kwargs):
        raise AssertionError("the control branch ran")

    monkeypatch.setattr(tiny_pipeline.control, "forward", never)
    result = tiny_pipeline(PROMPT, frames=16, preset="accurate")
    assert result.control_error.tolist() == [0.0]
    assert result.best.extra == {}
    assert result.seconds_taken > 0


@pytest.mark.parametrize("controls", [[], ()])
def test_empty_controls_take_the_text_path(tiny_pipeline, controls):
    plain = tiny_pipeline(PROMPT, frames=16, preset=QUICK)
    assert torch.equal(
        joints(tiny_pipeline(PROMPT, frames=16, controls=controls, preset=QUICK)), joints(plain)
    )


def test_a_pelvis_that_starts_elsewhere_moves_the_whole_scene(tiny_pipeline):
    offset = torch.tensor([3.0, 0.0, -2.0])
    points = torch.tensor([[0.0, 0.9, 0.0], [0.3, 0.9, 0.5]])
    at_origin, elsewhere = (
        tiny_pipeline(
            PROMPT, frames=24, controls=[JointControl("pelvis", [0, 20], points + shift)], preset=QUICK
        )
        for shift in (0 * offset, offset)
    )
    torch.testing.assert_close(joints(elsewhere) - offset, joints(at_origin), rtol=0, atol=SAME_MOTION)
    torch.testing.assert_close(elsewhere.control_error, at_origin.control_error, rtol=0, atol=SAME_MOTION)
    assert elsewhere.best.joints[0, 0, [0, 2]].tolist() == pytest.approx([3.0, -2.0], abs=1e-5)


def test_a_ground_path_leaves_the_height_free(tiny_pipeline):
    result = tiny_pipeline(
        PROMPT, frames=24, controls=[PathControl("pelvis", xz=[[1, 1], [1, 3]])], preset=QUICK
    )
    mask = result.best.extra["mask"]
    assert mask[:, 0, [0, 2]].all()
    assert mask.sum() == 48
    assert result.best.joints[0, 0, [0, 2]].tolist() == pytest.approx([1.0, 1.0], abs=1e-5)


def test_targets_come_back_in_the_users_frame(tiny_pipeline):
    control = JointControl("pelvis", [0, 5], [[3.0, 0.9, 1.0], [3.5, 0.9, 1.5]])
    motion = tiny_pipeline(PROMPT, frames=16, controls=[control], preset=QUICK).best
    assert torch.equal(motion.extra["targets"][[0, 5], 0], control.positions)


def test_progress_is_told_about_both_phases(tiny_pipeline):
    calls = []
    tiny_pipeline(
        PROMPT, frames=16, controls=[WRIST], preset=QUICK, progress=lambda *call: calls.append(call)
    )
    assert calls == [("masked decoding", i, 3) for i in (1, 2, 3)] + [
        ("codebook editing", i, 5) for i in range(1, 6)
    ]


def test_the_guidance_scale_can_be_overridden(tiny_pipeline):
    results = [
        tiny_pipeline(PROMPT, frames=40, preset=QUICK, guidance_scale=scale) for scale in (None, 4.0, 40.0)
    ]
    assert torch.equal(joints(results[0]), joints(results[1]))
    assert not torch.equal(joints(results[0]), joints(results[2]))


def test_motions_can_be_saved(tiny_pipeline, tmp_path):
    result = tiny_pipeline(PROMPT, frames=16, controls=[WRIST], preset=QUICK)
    loaded = Motion.load(result.best.save(tmp_path / "walk.npz"))
    torch.testing.assert_close(loaded.joints, result.best.joints)
    assert loaded.text == PROMPT


def test_no_gradient_is_kept(tiny_pipeline):
    result = tiny_pipeline(PROMPT, frames=16, controls=[WRIST], preset=QUICK)
    assert not result.latents.requires_grad
    assert not result.best.joints.requires_grad
    assert all(parameter.grad is None for parameter in tiny_pipeline.transformer.parameters())
    assert math.isfinite(result.control_error.item())


@pytest.fixture
def decoded(tiny_pipeline, monkeypatch):
    """One controlled call without editing: result, final logits, and the motions that signals came from."""
    from controlmm.pipelines import token_drawing as module

    seen = {"current": []}
    decode, signal = module.decode_with_control, ControlBranch.signal

    def kept_logits(*args, **options):
        seen["logits"] = decode(*args, **options)
        return seen["logits"]

    def kept_signal(branch, targets, mask, current):
        seen["current"].append(current)
        return signal(branch, targets, mask, current)

    monkeypatch.setattr(module, "decode_with_control", kept_logits)
    monkeypatch.setattr(ControlBranch, "signal", kept_signal)
    plan = Preset(EditingBudget(latent_iterations=0), steps=3)
    seen["result"] = tiny_pipeline(PROMPT, frames=16, controls=[WRIST], preset=plan)
    return seen


def test_the_first_control_signal_compares_with_the_motion_of_mean_codes(tiny_pipeline, decoded):
    mean = tiny_pipeline.decoder.tokenizer.base_codes.mean(0).expand(1, 4, 16)
    wrist = decoded["current"][0][:, :, 21]  # the joint that has a target
    torch.testing.assert_close(wrist, tiny_pipeline.decoder(mean)[:, :, 21])
    assert not torch.allclose(decoded["current"][1], decoded["current"][0])


def test_editing_starts_from_a_soft_base_layer_and_hard_residual_layers(tiny_pipeline, decoded):
    tokenizer, logits = tiny_pipeline.decoder.tokenizer, decoded["logits"]
    left = decoded["result"].latents - logits.softmax(-1) @ tokenizer.base_codes
    first, second = (tokenizer.quantizer.book(layer).codes for layer in (1, 2))
    sums = (first[:, None] + second).flatten(0, 1)
    assert torch.cdist(left[0], sums).amin(1).max() < 1e-2  # cdist takes roots of rounded squares


def test_a_call_takes_one_thread_and_gives_the_others_back(tiny_pipeline):
    """On a machine whose cores are busy, small operators of several threads wait for each other."""
    before, seen = torch.get_num_threads(), set()
    try:
        torch.set_num_threads(2)
        tiny_pipeline("walks", frames=24, progress=lambda *_: seen.add(torch.get_num_threads()))
        assert seen == {1}
        assert torch.get_num_threads() == 2
        with pytest.raises(ValueError, match="`samples`"):
            tiny_pipeline("walks", frames=24, samples=0)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
