"""Editing a motion that exists: what stays, where it stands, and what is refused."""

from __future__ import annotations

import pytest
import torch

from controlmm.controls import yaw_matrix
from controlmm.generation.editing import EditingBudget
from controlmm.generation.inpainting import inpaint_tokens, vary_tokens
from controlmm.generation.masked_decoding import DecodingRequest
from controlmm.generation.noise import ClipNoise
from controlmm.motion.motion import Motion
from controlmm.motion.skeleton import KIT
from controlmm.pipelines import Preset
from controlmm.pipelines.source_motion import SourceMotion, kept_frames

QUICK = Preset(EditingBudget(latent_iterations=3), steps=3)
UNEDITED = Preset(EditingBudget(latent_iterations=0), steps=3)
EDITED = Preset(EditingBudget(latent_iterations=200), steps=3)
SAME_PLACE = 2e-3  # metres; features are float32 and the root's way is summed up


@pytest.fixture
def source(walk) -> Motion:
    """A walk that stands somewhere in the world and faces somewhere."""
    return Motion(walk(41, turn=0.6, heading=0.9).float() + torch.tensor([2.0, 0.3, -5.0]))


def request_of(pipeline, tokens, *, samples=1, seed=3):
    text = pipeline.text_encoder.encode(["a person jumps"]).pooled.expand(samples, -1)
    valid = torch.ones(samples, tokens, dtype=torch.bool)
    return DecodingRequest(text, valid, ClipNoise([seed] * samples), steps=4)


def test_inpainting_draws_the_editable_tokens_and_no_other(tiny_pipeline):
    base = tiny_pipeline.transformer
    ids = torch.randint(0, base.config.codebook_size, (1, 12), generator=torch.Generator().manual_seed(0))
    editable = torch.zeros(1, 12, dtype=torch.bool)
    editable[0, 4:9] = True
    drawn = inpaint_tokens(base, request_of(tiny_pipeline, 12), ids, editable)
    assert torch.equal(drawn[~editable], ids[~editable])
    assert (drawn[editable] != ids[editable]).any()
    assert (drawn < base.config.codebook_size).all()
    assert (drawn >= 0).all()


def test_the_network_sees_what_is_kept_and_ever_fewer_masks(tiny_pipeline, monkeypatch):
    base, seen = tiny_pipeline.transformer, []
    embed = type(base).embed
    monkeypatch.setattr(
        type(base), "embed", lambda self, ids: (seen.append(ids.clone()), embed(self, ids))[1]
    )
    editable = torch.arange(12)[None] >= 4
    inpaint_tokens(base, request_of(tiny_pipeline, 12), torch.full((1, 12), 5), editable)
    assert all((ids[0, :4] == 5).all() for ids in seen)
    assert [int((ids == base.mask_id).sum()) for ids in seen] == [8, 7, 4, 1]  # round(8 cos(pi t / 2))


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
    ],
)
def test_impossible_edits_are_refused(tiny_pipeline, monkeypatch, source, options, kind, message):
    def never(*args, **kwargs):
        raise AssertionError("a network ran")

    monkeypatch.setattr(type(tiny_pipeline.text_encoder), "encode", never)
    with pytest.raises(kind, match=message):
        tiny_pipeline.edit(**{"motion": source, "prompt": "a person jumps", **options})
