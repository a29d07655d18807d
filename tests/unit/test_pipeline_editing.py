"""Editing a motion that exists: what stays, where it stands, and what is refused."""

from __future__ import annotations

import pytest
import torch

from controlmm.controls import Avoid, JointControl, Objective, PathControl, Sphere, penetration, yaw_matrix
from controlmm.generation.decoding_request import DecodingRequest
from controlmm.generation.editing import EditingBudget
from controlmm.generation.kept_tokens import KeptTokens
from controlmm.generation.masked_decoding import decode_from_text
from controlmm.generation.noise import ClipNoise
from controlmm.generation.objective import ControlObjective
from controlmm.generation.variation import vary_tokens
from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import HUMANML3D, KIT
from controlmm.pipelines import Preset
from controlmm.pipelines.source_motion import SourceMotion, kept_frames
from controlmm.pipelines.token_drawing import drawn_latents

QUICK = Preset(EditingBudget(latent_iterations=3), steps=3)
UNEDITED = Preset(EditingBudget(latent_iterations=0), steps=3)
EDITED = Preset(EditingBudget(latent_iterations=200), steps=3)
SAME_PLACE = 2e-3  # metres; features are float32 and the root's way is summed up


@pytest.fixture
def source(walk) -> Motion:
    """A walk that stands somewhere in the world and faces somewhere."""
    return Motion(walk(41, turn=0.6, heading=0.9).float() + torch.tensor([2.0, 0.3, -5.0]))


def request_of(pipeline, tokens, *, samples=1, seed=3, kept=None):
    text = pipeline.text_encoder.encode(["a person jumps"]).pooled.expand(samples, -1)
    valid = torch.ones(samples, tokens, dtype=torch.bool)
    return DecodingRequest(text, valid, ClipNoise([seed] * samples), steps=4, kept=kept)


def codes(pipeline, tokens):
    """(1, L, Q) codes of no motion in particular."""
    sizes = (1, tokens, pipeline.decoder.tokenizer.config.num_quantizers)
    bound = pipeline.transformer.config.codebook_size
    return torch.randint(0, bound, sizes, generator=torch.Generator().manual_seed(0))


def test_inpainting_draws_the_tokens_that_are_not_kept_and_no_other(tiny_pipeline):
    base, ids = tiny_pipeline.transformer, codes(tiny_pipeline, 12)
    where = torch.ones(1, 12, dtype=torch.bool)
    where[0, 4:9] = False
    drawn = decode_from_text(base, request_of(tiny_pipeline, 12, kept=KeptTokens(ids, where)))
    assert torch.equal(drawn[where], ids[..., 0][where])
    assert (drawn[~where] != ids[..., 0][~where]).any()
    assert (drawn < base.config.codebook_size).all()
    assert (drawn >= 0).all()


def test_the_network_sees_what_is_kept_and_ever_fewer_masks(tiny_pipeline, monkeypatch):
    base, seen = tiny_pipeline.transformer, []
    embed = type(base).embed
    monkeypatch.setattr(
        type(base), "embed", lambda self, ids: (seen.append(ids.clone()), embed(self, ids))[1]
    )
    ids = torch.full_like(codes(tiny_pipeline, 12), 5)
    kept = KeptTokens(ids, torch.arange(12)[None] < 4)
    decode_from_text(base, request_of(tiny_pipeline, 12, kept=kept))
    assert all((ids[0, :4] == 5).all() for ids in seen)
    assert [int((ids == base.mask_id).sum()) for ids in seen] == [8, 7, 4, 1]  # round(8 cos(pi t / 2))


@pytest.mark.parametrize("logits_iterations", [0, 3])
def test_kept_tokens_survive_decoding_under_control(tiny_pipeline, logits_iterations):
    """Layer by layer, whatever the branch, the noise and logits editing make of the others."""
    ids = codes(tiny_pipeline, 10)
    where = torch.arange(10)[None] >= 6
    targets = torch.full((1, 40, 22, 3), 0.5)
    mask = torch.zeros(targets.shape, dtype=torch.bool)
    mask[:, 5, 21] = True
    plan = Preset(EditingBudget(logits_iterations=logits_iterations, latent_iterations=0), steps=3)
    request = request_of(tiny_pipeline, 10, kept=KeptTokens(ids, where))
    frames = torch.ones(1, 40, dtype=torch.bool)
    objective = ControlObjective(tiny_pipeline.decoder, targets, mask, frames)
    latents = drawn_latents(tiny_pipeline, request, objective, tiny_pipeline.control, plan)
    wanted = tiny_pipeline.decoder.tokenizer.quantizer.lookup(ids)
    torch.testing.assert_close(latents[where], wanted[where])
    assert (latents[~where] - wanted[~where]).abs().max() > 1e-3


def test_variation_changes_some_tokens_a_step(tiny_pipeline):
    base = tiny_pipeline.transformer
    ids = torch.randint(0, base.config.codebook_size, (1, 25), generator=torch.Generator().manual_seed(0))
    varied = vary_tokens(base, request_of(tiny_pipeline, 25), ids)
    changed = int((varied != ids).sum())
    assert 1 <= changed <= 4 * 4  # four steps of round(0.16 * 25) tokens


def test_a_source_goes_to_the_networks_frame_and_back(source):
    made_ready = SourceMotion.of(source, skeleton=source.skeleton, max_frames=196)
    assert made_ready.num_frames == source.num_frames
    assert made_ready.joints[0, 0, [0, 2]].abs().max() < 1e-5
    assert made_ready.joints[..., 1].min().abs() < 1e-3
    torch.testing.assert_close(made_ready.placed(made_ready.joints), source.joints, rtol=0, atol=SAME_PLACE)


def test_turning_and_moving_the_source_turns_and_moves_the_result(tiny_pipeline, source):
    turn, shift = yaw_matrix(100), torch.tensor([4.0, 0.5, 1.0])
    moved = Motion(source.joints @ turn.T + shift)
    first, second = (
        tiny_pipeline.edit(motion, "a person jumps", keep=[(0, 1)], preset=QUICK, seed=2).best.joints
        for motion in (source, moved)
    )
    torch.testing.assert_close(first @ turn.T + shift, second, rtol=0, atol=0.02)


def test_exact_editing_moves_kept_poses_back_onto_the_source(tiny_pipeline, source):
    errors = {}
    for name, exact, plan in (("drawn", False, UNEDITED), ("exact", True, EDITED)):
        result = tiny_pipeline.edit(
            source, "a person jumps", keep=[(0, 0.6), (1.4, 2.05)], exact=exact, preset=plan, samples=2
        )
        assert all(motion.num_frames == 41 for motion in result)
        kept = kept_frames(41, [(0, 0.6), (1.4, 2.05)], 20)
        distances = torch.stack([(m.joints - source.joints)[kept].norm(dim=-1).mean() for m in result])
        torch.testing.assert_close(distances, result.control_error, rtol=0.02, atol=SAME_PLACE)
        errors[name] = distances.mean().item()
    assert errors["exact"] < 0.5 * errors["drawn"]


def test_keeping_a_part_controls_it_at_all_frames(tiny_pipeline, source):
    result = tiny_pipeline.edit(source, "a person waves", keep_parts=["lower"], preset=EDITED)
    mask, targets = result.best.extra["mask"], result.best.extra["targets"]
    assert mask.any(0).any(-1).nonzero()[:, 0].tolist() == [0, 10, 11]
    assert mask[:, [0, 10, 11]].all()
    torch.testing.assert_close(targets[mask], source.joints[mask], rtol=0, atol=SAME_PLACE)
    unedited = tiny_pipeline.edit(source, "a person waves", keep_parts=["lower"], preset=UNEDITED)
    assert result.control_error.item() < 0.5 * unedited.control_error.item()


def test_controls_are_met_among_kept_poses_wherever_the_motion_stands(tiny_pipeline, source):
    """One hand target of 3 coordinates does not drown in 1 300 kept ones."""
    wanted = source.joints[20, 21] + torch.tensor([0.1, 0.3, 0.0])
    reach = JointControl("right_wrist", [20], [wanted.tolist()])
    options = {"keep": [(0, 0.6), (1.4, 2.05)], "preset": EDITED}
    result = tiny_pipeline.edit(source, "a person reaches out", controls=[reach], **options)
    kept = kept_frames(41, [(0, 0.6), (1.4, 2.05)], 20)
    hand = (result.best.joints[20, 21] - wanted).norm().item()
    poses = (result.best.joints - source.joints)[kept].norm(dim=-1).mean().item()
    assert result.control_error.item() == pytest.approx(max(hand, poses), abs=SAME_PLACE)
    plain = tiny_pipeline.edit(source, "a person reaches out", **options)
    assert hand < 0.3 * (plain.best.joints[20, 21] - wanted).norm().item()
    assert result.best.extra["mask"].nonzero()[:, :2].unique(dim=0).tolist() == [[20, 21]]
    turned = Motion(source.joints @ yaw_matrix(100).T)
    there = JointControl("right_wrist", [20], [(yaw_matrix(100) @ wanted).tolist()])
    again = tiny_pipeline.edit(turned, "a person reaches out", controls=[there], **options).best
    torch.testing.assert_close(again.joints @ yaw_matrix(100), result.best.joints, rtol=0, atol=0.03)


def test_a_single_axis_is_met_in_the_world_of_a_turned_motion(tiny_pipeline, source):
    """x alone is no axis of the networks' frame there."""
    x = source.joints[20, 0, 0].item() + 0.2
    only_x = JointControl("pelvis", [20], [[x, None, None]])
    result = tiny_pipeline.edit(source, "a person walks", controls=[only_x], preset=EDITED)
    assert result.best.joints[20, 0, 0].item() == pytest.approx(x, abs=0.05)
    assert result.control_error.item() == pytest.approx(
        abs(result.best.joints[20, 0, 0].item() - x), abs=1e-4
    )


def test_obstacles_and_objectives_count_in_the_world_of_the_motion(tiny_pipeline, source):
    ball = Sphere((source.joints[30, 0] + torch.tensor([0.15, 0.0, 0.0])).tolist(), 0.25)
    seen = []

    def high(joints):
        seen.append(joints.detach())
        return joints[:, 30, 0, 1] * 0

    options = {"keep_parts": ["left_foot"], "preset": EDITED}
    result = tiny_pipeline.edit(
        source, "a person walks", obstacles=[ball], objectives=[Objective(high)], **options
    )
    blind = tiny_pipeline.edit(source, "a person walks", **options).best
    assert result.penetration.item() < 0.5 * penetration(blind.joints[None], [Avoid(ball)], HUMANML3D).item()
    assert result.best.extra["obstacles"][0].shape == ball
    assert (seen[-1][0, :, 0] - source.joints[:, 0]).norm(dim=-1).max() < 2


def test_without_anything_kept_the_motion_is_varied(tiny_pipeline, source):
    first, again, other = (
        tiny_pipeline.edit(source, "a person jumps", preset=QUICK, seed=seed) for seed in (1, 1, 2)
    )
    assert torch.equal(first.best.joints, again.best.joints)
    assert not torch.equal(first.best.joints, other.best.joints)
    assert first.control_error.item() == 0


def test_a_motion_of_the_pipeline_can_be_edited_again(tiny_pipeline):
    made = tiny_pipeline("a person walks", frames=42, preset=QUICK).best
    assert made.features is not None
    result = tiny_pipeline.edit(made, "a person jumps", keep=[(0, 1)], preset=QUICK)
    assert result.best.num_frames == 42


@pytest.mark.parametrize(
    ("options", "kind", "message"),
    [
        (
            {"motion": "walk.npz"},
            TypeError,
            r"`motion` must be a Motion, got str\. Read a file with Motion\.load",
        ),
        (
            {"motion": Motion(torch.zeros(9, 21, 3), skeleton=KIT)},
            ValueError,
            r"the humanml3d skeleton, got kit",
        ),
        ({"motion": Motion(torch.zeros(5, 22, 3))}, ValueError, r"must have 8 to 196 frames, got 5"),
        (
            {"keep": [(1, 3)]},
            ValueError,
            r"`keep\[0\]` must lie within the motion, 0 to 2\.05 s, .* got 1 to 3",
        ),
        ({"keep": [(1, 1)]}, ValueError, r"`keep\[0\]` must lie within the motion"),
        ({"keep": [1.0]}, TypeError, r"`keep\[0\]` must be \(start, end\) in seconds, got 1\.0"),
        ({"keep": "0-1"}, TypeError, r"`keep` must be a list of \(start, end\)"),
        ({"keep": [(0, 2.05)]}, ValueError, r"keep everything, so there is nothing to change"),
        ({"keep_parts": "lower"}, TypeError, r"`keep_parts` must be a list of parts, .* Pass \['lower'\]"),
        ({"keep_parts": ["lowr"]}, ValueError, r'Unknown part "lowr"\. Did you mean "lower"\?'),
        ({"prompt": " "}, ValueError, r"`prompt`"),
        ({"exact": False}, ValueError, r"`exact=False` is about `keep`, and nothing is kept by it"),
        ({"preset": "exact"}, ValueError, r"`preset` 'exact' makes single motions.* Use 'accurate'"),
        (
            {"keep": [(0, 1)], "controls": [PathControl("pelvis", xz=[[0, 0], [1, 1]])]},
            ValueError,
            r"`controls` want pelvis x = 0\.000 m at frame 0, but what is kept has it at 2\.\d+ m",
        ),
        (
            {"keep_parts": ["lower"], "obstacles": [Sphere((2.0, 1.0, -5.0), 0.5)]},
            ValueError,
            r"What is kept has \w+ at frame \d+ 0\.\d+ m inside obstacle 0 \(sphere\), which",
        ),
        (
            {
                "obstacles": [Sphere((0, 1, 0), 0.5)],
                "controls": [JointControl("head", [3], [[0, 1, 0]])],
            },
            ValueError,
            r"The target of head at frame 3 lies 0\.500 m inside obstacle 0",
        ),
        (
            {"controls": [JointControl("head", [50], [[0, 1, 0]])]},
            ValueError,
            r"names frame 50, but the clip has 41 frames",
        ),
        ({"objectives": [lambda joints: joints]}, TypeError, r"`objectives\[0\]` must be an Objective"),
    ],
)
def test_impossible_edits_are_refused(tiny_pipeline, monkeypatch, source, options, kind, message):
    def never(*args, **kwargs):
        raise AssertionError("a network ran")

    monkeypatch.setattr(type(tiny_pipeline.text_encoder), "encode", never)
    with pytest.raises(kind, match=message):
        tiny_pipeline.edit(**{"motion": source, "prompt": "a person jumps", **options})


def test_a_motion_drifts_for_ten_steps_however_few_a_preset_draws_in(tiny_pipeline, source):
    seen = []
    tiny_pipeline.edit(source, "a person jumps", preset=QUICK, progress=lambda *step: seen.append(step))
    assert [step for step in seen if step[0] == "masked decoding"] == [
        ("masked decoding", done, 10) for done in range(1, 11)
    ]
