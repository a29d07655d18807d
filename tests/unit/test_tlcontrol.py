"""TLControl's call: the same as ControlMM's, part by part variation, tolerance, published form, folders."""

from __future__ import annotations

from dataclasses import asdict

import pytest
import torch

from controlmm.controls import JointControl, PathControl
from controlmm.generation.code_prediction import CodePrediction
from controlmm.generation.code_sampling import draw_part_codes
from controlmm.generation.noise import clip_seeds
from controlmm.models.part_vq_vae import PartVqVae, PartVqVaeConfig
from controlmm.models.trajectory_transformer import TrajectoryTransformer, TrajectoryTransformerConfig
from controlmm.motion.normalizer import Normalizer
from controlmm.motion.skeleton import KIT
from controlmm.pipelines import (
    TLCONTROL_PRESETS,
    ControlMM,
    Preset,
    TLControl,
    TLControlPreset,
    load_pipeline,
)
from controlmm.text.hashing import HashingTextEncoder

PROMPT = "a person walks forward"
QUICK = TLControlPreset(iterations=4)
SAME_MOTION = 1e-3  # metres: a few steps of L-BFGS multiply the rounding of sums in another order
WRIST = JointControl("right_wrist", frames=[3, 12], positions=[[-0.3, 1.2, 0.2], [-0.2, 1.4, 0.5]])
ELBOW = JointControl("left_elbow", frames=[10], positions=[[0.3, 1.2, 0.2]])  # no trajectory of the six


def joints(result) -> torch.Tensor:
    return torch.stack([motion.joints for motion in result])


@pytest.mark.parametrize("controls", [[], [WRIST]], ids=["text", "control"])
def test_the_same_seed_gives_the_same_motion_and_another_seed_another(tiny_tlcontrol, controls):
    torch.manual_seed(0)
    before = torch.get_rng_state()
    first, again, other = (
        joints(tiny_tlcontrol(PROMPT, frames=24, controls=controls, preset=QUICK, seed=seed))
        for seed in (3, 3, 4)
    )
    assert torch.equal(first, again)
    assert (first - other).abs().max() > 1e-3
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("controls", [[], [WRIST]], ids=["text", "control"])
def test_a_sample_does_not_depend_on_how_many_are_asked_for(tiny_tlcontrol, controls):
    options = {"frames": 40, "controls": controls, "preset": QUICK, "seed": 2}
    many, few = (joints(tiny_tlcontrol(PROMPT, samples=count, **options)) for count in (3, 1))
    torch.testing.assert_close(many[:1], few, rtol=0, atol=SAME_MOTION)
    assert (many[0] - many[1]).abs().max() > 1e-3


@pytest.mark.parametrize("frames", [8, 41, 195, 196])
def test_motions_have_the_length_that_was_asked_for(tiny_tlcontrol, frames):
    control = JointControl("head", frames=[frames - 1], positions=[[0.1, 1.5, 0.4]])
    for controls in ([], [control]):
        (motion,) = tiny_tlcontrol(PROMPT, frames=frames, controls=controls, preset=QUICK)
        assert motion.joints.shape == (frames, 22, 3)
        assert torch.isfinite(motion.joints).all()


@pytest.mark.parametrize(
    "control",
    [WRIST, ELBOW, PathControl("pelvis", xz=[[0, 0], [0, 1]])],
    ids=["wrist", "joint without trajectory", "two axes"],
)
def test_optimisation_meets_targets_of_any_joint_and_axes(tiny_tlcontrol, control):
    before, after = (
        tiny_tlcontrol(PROMPT, frames=40, controls=[control], preset=TLControlPreset(iterations=iterations))
        for iterations in (0, 300)
    )
    assert after.control_error.item() < 0.2 * before.control_error.item()


def test_a_smaller_tolerance_ends_nearer_the_targets_after_more_evaluations(tiny_tlcontrol):
    generator = torch.Generator().manual_seed(0)
    latents = torch.randn(2, 5, 24, generator=generator)
    targets = tiny_tlcontrol.decoder(torch.randn(2, 5, 24, generator=generator))
    mask = torch.zeros(targets.shape, dtype=torch.bool)
    mask[:, :, [0, 15, 20, 21, 10, 11]] = True
    valid = torch.ones(2, 5, dtype=torch.bool)
    errors, evaluations = [], []
    for tolerance in (1e-3, 1e-5, 1e-7):
        preset = TLControlPreset(tolerance=tolerance, foot="none")
        solution = tiny_tlcontrol.optimize(latents, valid, targets, mask, preset)
        assert set(solution.reasons) == {"converged"}
        distance = (tiny_tlcontrol.decoder(solution.latents) - targets).norm(dim=-1)
        errors.append(distance[mask.all(-1)].mean().item())
        evaluations.append(solution.evaluations.sum().item())
    assert errors[0] > errors[1] > errors[2]
    assert evaluations[0] < evaluations[1] < evaluations[2]


def test_iterations_are_capped(tiny_tlcontrol):
    targets = torch.zeros(1, 20, 22, 3)
    mask = torch.ones(1, 20, 22, 3, dtype=torch.bool)
    valid = torch.ones(1, 5, dtype=torch.bool)
    preset = TLControlPreset(iterations=8, tolerance=1e-12)
    solution = tiny_tlcontrol.optimize(torch.zeros(1, 5, 24), valid, targets, mask, preset)
    assert solution.evaluations.item() <= 10
    assert solution.reasons[0] in ("iterations", "evaluations")


def test_clips_of_a_mixed_batch_equal_the_clips_alone(tiny_tlcontrol):
    """Three lengths, two with targets and one without, three prompts."""
    prompts, lengths, seeds = ["walk", "wave both hands", "sit down"], [40, 17, 28], clip_seeds(1, 3)
    targets = torch.rand(3, 40, 22, 3, generator=torch.Generator().manual_seed(0))
    mask = torch.zeros(3, 40, 22, 3, dtype=torch.bool)
    mask[0, [5, 39], 21] = True
    mask[1, 16, 0] = True

    def latents(rows, lengths, targets, mask):
        text = tiny_tlcontrol.text_encoder.encode(prompts[rows]).pooled
        return tiny_tlcontrol.generate_latents(
            text, lengths=lengths, targets=targets, mask=mask, seeds=seeds[rows], preset=QUICK
        )

    together = latents(slice(0, 3), lengths, targets, mask)
    for clip, length in enumerate(lengths):
        rows = slice(clip, clip + 1)
        alone = latents(rows, [length], targets[rows, :length], mask[rows, :length])
        torch.testing.assert_close(together[rows, : alone.shape[1]], alone, rtol=0, atol=1e-3)
        assert together[clip, alone.shape[1] :].abs().sum() == 0


def part_latents(pipeline, **changes) -> torch.Tensor:
    """(S, L, 6, 4)"""
    latents = pipeline(PROMPT, frames=40, samples=3, seed=1, **changes).latents
    return latents.unflatten(-1, (6, 4))


def test_one_part_varies_and_the_others_keep_the_first_samples_codes(tiny_tlcontrol):
    latents = part_latents(tiny_tlcontrol, vary="left_arm")
    others = [part for part in range(6) if part != 2]
    assert torch.equal(latents[1][:, others], latents[0][:, others])
    assert (latents[1][:, 2] - latents[0][:, 2]).abs().max() > 0
    assert (latents[2][:, 2] - latents[1][:, 2]).abs().max() > 0
    assert torch.equal(latents[0], part_latents(tiny_tlcontrol)[0])


def test_without_vary_all_parts_differ_between_samples(tiny_tlcontrol):
    latents = part_latents(tiny_tlcontrol)
    assert ((latents[1] - latents[0]).abs().amax((0, 2)) > 0).all()


def test_temperature_zero_takes_the_most_likely_codes(tiny_tlcontrol):
    latents = part_latents(tiny_tlcontrol, preset=TLControlPreset(temperature=0.0))
    assert torch.equal(latents[1], latents[0])


def test_a_part_varies_however_cold_the_draws_are(tiny_tlcontrol):
    latents = part_latents(tiny_tlcontrol, vary="left_arm", preset=TLControlPreset(temperature=0.0))
    assert (latents[1][:, 2] - latents[0][:, 2]).abs().max() > 0
    assert torch.equal(latents[1][:, 3], latents[0][:, 3])


def test_a_round_shows_the_network_its_own_trajectories_where_nothing_is_given(tiny_tlcontrol):
    frames, tokens = 24, 6
    valid = torch.ones(1, tokens, dtype=torch.bool)
    text = tiny_tlcontrol.text_encoder.encode([PROMPT]).pooled
    prediction = CodePrediction(tiny_tlcontrol.transformer, tiny_tlcontrol.decoder, text, valid, [3])
    targets, mask = torch.zeros(1, frames, 22, 3), torch.zeros(1, frames, 22, 3, dtype=torch.bool)
    targets[:, :, 20] = torch.tensor([0.4, 1.2, 0.3])
    mask[:, :, 20] = True
    first = prediction.latents(targets, mask, rounds=0, temperature=0.5)
    motion = tiny_tlcontrol.decoder(first, torch.ones(1, frames, dtype=torch.bool))
    own = targets.where(mask, motion)
    everything = mask.clone()
    everything[:, :, list(tiny_tlcontrol.transformer.config.joints)] = True
    expected = prediction.latents(own, everything, rounds=0, temperature=0.0)
    assert torch.equal(prediction.latents(targets, mask, rounds=1, temperature=0.5), expected)
    assert not torch.equal(expected, first)
    given = prediction.latents(own, everything, rounds=3, temperature=0.5)
    assert torch.equal(given, expected)  # nothing is left to fill


def test_every_token_is_a_fair_draw_from_its_logits():
    logits = torch.tensor([2.0, 1.0, 0.0, -1.0]).expand(1, 1, 1, 4).clone()
    counts = torch.zeros(4)
    for seed in range(1000):
        counts[draw_part_codes(logits, [seed], temperature=0.5)] += 1
    expected = (logits[0, 0, 0] / 0.5).softmax(-1)
    spread = 4 * (expected * (1 - expected) / 1000).sqrt()  # four standard deviations
    assert ((counts / 1000 - expected).abs() < spread).all()


def test_tokens_of_a_part_share_their_noise_and_parts_do_not():
    logits = torch.zeros(1, 9, 6, 16)
    ids = draw_part_codes(logits, [5], temperature=1.0)
    assert (ids == ids[:, :1]).all()
    assert len(ids[0, 0].unique()) > 1


def test_the_text_counts_more_with_a_larger_guidance_scale(tiny_tlcontrol):
    results = [
        joints(tiny_tlcontrol(PROMPT, frames=40, preset=QUICK, guidance_scale=scale))
        for scale in (None, 1.0, 100.0)
    ]
    assert torch.equal(results[0], results[1])
    assert (results[0] - results[2]).abs().max() > 1e-3


@pytest.fixture
def published(tiny_tlcontrol) -> TLControl:
    """Tiny networks of the published form."""
    torch.manual_seed(3)
    tokenizer = PartVqVae(PartVqVaeConfig(**{**asdict(PartVqVaeConfig.tiny()), "latent_norm": "clip"}))
    for part in range(6):
        tokenizer.quantizer.book(part).codes.normal_()
    config = TrajectoryTransformerConfig(
        **{**asdict(TrajectoryTransformerConfig.tiny()), "form": "published"}
    )
    return TLControl(
        tokenizer=tokenizer,
        transformer=TrajectoryTransformer(config),
        normalizer=tiny_tlcontrol.decoder.normalizer,
        text_encoder=HashingTextEncoder(64),
    )


def test_networks_of_the_published_form_always_work_on_their_full_length(published):
    result = published(PROMPT, frames=40, controls=[WRIST], preset=QUICK)
    assert result.latents.shape == (1, 49, 24)
    assert result.best.num_frames == 40


def test_kit_has_its_own_partition_joints_and_unit():
    torch.manual_seed(3)
    tokenizer = PartVqVae(PartVqVaeConfig.tiny().for_features(251))
    for part in range(6):
        tokenizer.quantizer.book(part).codes.normal_()
    pipeline = TLControl(
        tokenizer=tokenizer,
        transformer=TrajectoryTransformer(TrajectoryTransformerConfig.tiny().for_skeleton(KIT)),
        normalizer=Normalizer(torch.zeros(251), torch.full((251,), 50.0)),
        text_encoder=HashingTextEncoder(64),
    )
    control = JointControl("LW", frames=[3, 12], positions=[[-0.1, 0.6, 0.1], [-0.1, 0.7, 0.2]])
    result = pipeline(PROMPT, frames=24, controls=[control], preset=QUICK)
    assert result.best.joints.shape == (24, 21, 3)
    assert torch.isfinite(result.best.joints).all()


def test_networks_of_different_forms_do_not_fit(tiny_tlcontrol, published):
    with pytest.raises(ValueError, match="`form` of `transformer` must be masked, got published"):
        TLControl(
            tokenizer=tiny_tlcontrol.tokenizer,
            transformer=published.transformer,
            normalizer=tiny_tlcontrol.decoder.normalizer,
            text_encoder=HashingTextEncoder(64),
        )


def test_a_saved_pipeline_generates_the_same_and_is_known_by_its_folder(tiny_tlcontrol, tmp_path):
    folder = tiny_tlcontrol.save_pretrained(tmp_path / "model")
    expected = joints(tiny_tlcontrol(PROMPT, frames=24, controls=[WRIST], preset=QUICK))
    for loaded in (TLControl.from_pretrained(folder), load_pipeline(folder)):
        assert isinstance(loaded, TLControl)
        assert torch.equal(joints(loaded(PROMPT, frames=24, controls=[WRIST], preset=QUICK)), expected)
    with pytest.raises(
        ValueError, match="holds a pipeline of kind 'tlcontrol', format 1; expected 'controlmm'"
    ):
        ControlMM.from_pretrained(folder)


def test_controlmm_folders_are_known_too(tiny_pipeline_folder):
    assert isinstance(load_pipeline(tiny_pipeline_folder), ControlMM)


def test_an_unknown_name_lists_the_models_that_ship():
    with pytest.raises(FileNotFoundError, match=r"or the name of a model .*: controlmm, tlcontrol"):
        load_pipeline("tlcontrl")


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        (
            {"preset": "exactly"},
            ValueError,
            "Unknown `preset` 'exactly'. Use one of: fast, balanced, accurate",
        ),
        ({"preset": None}, TypeError, "`preset` must be a name or a TLControlPreset, got NoneType"),
        ({"vary": "tail"}, ValueError, "Unknown body part 'tail'. Use one of: root, trunk, left_arm"),
        ({"samples": 0}, ValueError, "`samples` must be a whole number of at least 1, got 0"),
        ({"frames": 400}, ValueError, "`frames` must be between 8 and 196, got 400"),
    ],
)
def test_unusable_arguments_are_refused_before_any_network_runs(
    tiny_tlcontrol, monkeypatch, changes, error, message
):
    monkeypatch.setattr(tiny_tlcontrol, "transformer", None)
    with pytest.raises(error, match=message.replace(".", r"\.")):
        tiny_tlcontrol(PROMPT, **changes)


def test_a_preset_of_controlmm_is_refused(tiny_tlcontrol):
    from controlmm.pipelines import PRESETS

    with pytest.raises(TypeError, match="`preset` must be a name or a TLControlPreset, got Preset"):
        tiny_tlcontrol(PROMPT, preset=PRESETS["fast"])
    assert isinstance(PRESETS["fast"], Preset)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tolerance": 0}, "`tolerance` must be a positive number, got 0"),
        ({"rate": float("nan")}, "`rate` must be a positive number, got nan"),
        ({"iterations": -1}, "`iterations` must be a whole number of at least 0, got -1"),
        ({"history": 0}, "`history` must be a whole number of at least 1, got 0"),
        ({"temperature": -0.1}, "`temperature` must be a number of at least 0, got -0.1"),
        ({"guidance_scale": "2"}, "`guidance_scale` must be a finite number, got '2'"),
        ({"loss": "l2"}, "`loss` must be one of half_square, smooth_l1, norm_sum, got 'l2'"),
        ({"foot": "toe"}, "`foot` must be one of contact, published, none, got 'toe'"),
        ({"vary": "arm"}, "Unknown body part 'arm'"),
        ({"rounds": -1}, "`rounds` must be a whole number of at least 0, got -1"),
    ],
)
def test_impossible_presets_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        TLControlPreset(**changes)


def test_presets_have_the_tolerances_of_the_papers_table():
    tolerances = [TLCONTROL_PRESETS[name].tolerance for name in ("fast", "balanced", "accurate", "paper")]
    assert tolerances == [1e-5, 1e-6, 1e-8, 1e-6]
    paper = TLCONTROL_PRESETS["paper"]
    assert (paper.rate, paper.history, paper.iterations) == (0.1, 200, 1000)
    assert (paper.temperature, paper.guidance_scale) == (0.0, 1.0)
