"""What training draws: corrupted tokens, control masks, layers, windows, crops."""

from __future__ import annotations

import math

import pytest
import torch

from controlmm.data import Caption, FeatureClip
from controlmm.models.rvq_vae import RvqVae, RvqVaeConfig, frame_mask
from controlmm.motion.normalizer import Normalizer
from controlmm.motion.skeleton import HUMANML3D
from controlmm.training.control_masks import cross_masks, mixed_masks, random_frames, trajectory_masks
from controlmm.training.corruption import corrupt_tokens
from controlmm.training.residual import random_layers
from controlmm.training.rvq import layer_perplexities
from controlmm.training.tokens import TokenSampler
from controlmm.training.windows import WindowSampler, source_weights

SIGMAS = 4.5  # a right share is missed by this many standard errors once in 150 000 tests
MASK, PAD = 32, 33


def standard_error(share: float, draws: float) -> float:
    return SIGMAS * math.sqrt(share * (1 - share) / draws)


def corrupt(ids, valid):
    return corrupt_tokens(ids, valid, codebook_size=32, mask_id=MASK, pad_id=PAD)


def test_corruption_shares_are_the_published_ones():
    """10 % of the chosen positions become random codes, 88 % of the others MASK, the rest stay."""
    torch.manual_seed(0)
    ids = torch.full((4000, 49), 40)  # no code, so that random codes show
    corrupted, chosen = corrupt(ids, torch.ones(4000, 49, dtype=torch.bool))
    drawn, draws = corrupted[chosen], int(chosen.sum())
    assert (corrupted[~chosen] == 40).all()
    for share, found in ((0.1, drawn < 32), (0.9 * 0.88, drawn == MASK), (0.9 * 0.12, drawn == 40)):
        assert found.float().mean().item() == pytest.approx(share, abs=standard_error(share, draws))
    assert set(drawn[drawn < 32].tolist()) == set(range(32))


def test_hidden_share_follows_the_cosine_schedule():
    """cos(pi u / 2) over uniform u: mean 2 / pi, quartiles cos(3 pi / 8), cos(pi / 4), cos(pi / 8)."""
    torch.manual_seed(0)
    count = 6000
    _, chosen = corrupt(torch.zeros(count, 49, dtype=torch.long), torch.ones(count, 49, dtype=torch.bool))
    share = chosen.float().mean(1)
    assert share.mean() == pytest.approx(2 / math.pi, abs=0.02)
    quartiles = torch.quantile(share, torch.tensor([0.25, 0.5, 0.75]))
    expected = [math.cos(math.pi * u / 2) for u in (0.75, 0.5, 0.25)]
    assert quartiles.tolist() == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize("length", [1, 2, 10, 49])
def test_corruption_hides_at_least_one_token_and_never_padding(length):
    torch.manual_seed(0)
    valid = frame_mask(torch.full((200,), length), 49)
    corrupted, chosen = corrupt(torch.zeros(200, 49, dtype=torch.long), valid)
    assert (chosen.sum(1) >= 1).all()
    assert not chosen[~valid].any()
    assert (corrupted[~valid] == PAD).all()


def test_residual_layers_are_drawn_by_the_published_formula():
    """q = 1 + round((1 - cos(pi u / 2)) 4): bin edges of u where 4 (1 - cos) = 0.5, 1.5, 2.5, 3.5."""
    torch.manual_seed(0)
    draws = 40_000
    shares = torch.bincount(random_layers(draws, 6), minlength=7) / draws
    edges = [0.0, *(2 / math.pi * math.acos(1 - half / 4) for half in (0.5, 1.5, 2.5, 3.5)), 1.0]
    assert shares[0] == shares[6] == 0
    for layer in range(1, 6):
        expected = edges[layer] - edges[layer - 1]
        assert shares[layer].item() == pytest.approx(expected, abs=standard_error(expected, draws))


def test_mixed_masks_hold_every_kind_of_control_inside_the_clip():
    torch.manual_seed(0)
    frames = frame_mask(torch.full((1500,), 40), 48)
    masks = mixed_masks(frames, joints=22, favoured=HUMANML3D.control_joints)
    assert not masks[:, 40:].any()
    path = masks[:, :, 0, 0].any(1) & ~masks[:, :, 0, 1].any(1)
    nothing = ~masks.flatten(1).any(1)
    poses = masks.flatten(2).all(2).any(1)
    for share, found in ((0.2, path), (0.1, nothing), (0.1, poses)):
        assert found.float().mean().item() == pytest.approx(share, abs=standard_error(share, 1500))
    assert masks.any(1).any(2).any(0).all()  # every joint is controlled in some clip


def test_a_tenth_of_the_mixed_joint_controls_leaves_axes_free():
    torch.manual_seed(0)
    masks = mixed_masks(torch.ones(3000, 30, dtype=torch.bool), joints=22, favoured=HUMANML3D.control_joints)
    held = masks.any(1)[:, 1:]  # (clips, joints but the pelvis, axes)
    controlled = held[held.any(-1)]
    free = ~controlled.all(-1)
    # poses hold all axes of all 21 joints and are left out
    poses = 21 * masks.flatten(2).all(2).any(1).sum()
    share = (free.sum() / (len(controlled) - poses)).item()
    assert share == pytest.approx(0.1, abs=standard_error(0.1, len(controlled) - int(poses)))
    assert set(controlled[free].sum(-1).tolist()) == {1, 2}
    assert controlled[free].any(0).all()  # each axis is held alone or with another


def test_sparse_control_is_common():
    torch.manual_seed(0)
    counts = torch.tensor([len(random_frames(100)) for _ in range(2000)])
    assert counts.min() == 1
    assert counts.max() > 80
    # log-uniform: half of the draws are below the geometric mean of 1 and 101
    assert counts.float().median() == pytest.approx(math.sqrt(101), rel=0.15)
    frames = random_frames(100)
    assert len(frames.unique()) == len(frames)


def test_published_masks_control_whole_points_inside_the_clip():
    torch.manual_seed(0)
    frames = frame_mask(torch.tensor([40, 12, 196]), 196)
    for masks in (
        trajectory_masks(frames, joints=22),
        cross_masks(frames, joints=22, among=HUMANML3D.control_joints),
    ):
        assert torch.equal(masks.any(-1), masks.all(-1))
        assert not masks[~frames].any()
        assert masks.flatten(1).any(1).all()
    assert not trajectory_masks(frames, joints=22)[:, :, 1:].any()
    others = [joint for joint in range(22) if joint not in HUMANML3D.control_joints]
    assert not cross_masks(frames, joints=22, among=HUMANML3D.control_joints)[:, :, others].any()


def clip_of(name: str, frames: int, *captions: Caption, source: str = "lab") -> FeatureClip:
    """Channel 0 counts the frames, so that crops can be located."""
    features = torch.randn(frames, 263, generator=torch.Generator().manual_seed(frames))
    features[:, 0] = torch.arange(frames)
    return FeatureClip(name, features, captions or (Caption("walks"),), source)


@pytest.fixture(scope="module")
def identity() -> Normalizer:
    return Normalizer(torch.zeros(263), torch.ones(263))


def test_sources_weigh_with_the_square_root_of_their_size():
    weights = source_weights(["a", "a", "b"], [60, 40, 25])
    shares = weights / weights.sum()
    assert shares.tolist() == pytest.approx([0.6 * 10 / 15, 0.4 * 10 / 15, 5 / 15])


def test_windows_lie_inside_one_clip_and_reach_its_ends(identity):
    torch.manual_seed(0)
    clips = [clip_of("a", 66), clip_of("short", 63), clip_of("b", 70)]
    sampler = WindowSampler(clips, identity, length=64)
    windows = sampler.sample(2000)[..., 0]
    assert (windows.diff(dim=1) == 1).all()  # would jump at a border
    assert set(windows[:, 0].int().tolist()) == set(range(7))


def test_clips_too_short_for_windows_are_refused(identity):
    with pytest.raises(ValueError, match="No clip has 64 frames or more"):
        WindowSampler([clip_of("a", 63)], identity, length=64)


@pytest.fixture(scope="module")
def tokenizer() -> RvqVae:
    torch.manual_seed(0)
    tokenizer = RvqVae(RvqVaeConfig.tiny()).eval()
    for book in tokenizer.quantizer.books:
        book.codes.normal_()
    return tokenizer


TEXT = {name: torch.full((4,), float(i)) for i, name in enumerate(("walks", "stops", "left", "right"))}


def test_crops_have_the_tokens_of_their_frames(identity, tokenizer):
    torch.manual_seed(0)
    clips = [clip_of("a", 50), clip_of("b", 57)]
    sampler = TokenSampler(clips, identity, tokenizer, TEXT, progress=False)
    batch = sampler.sample(40)
    assert batch.features.shape[1] == 4 * batch.ids.shape[1]
    assert torch.equal(batch.frames.sum(1), 4 * batch.valid.sum(1))
    assert ((batch.ids >= 0).all(-1) == batch.valid).all()
    assert batch.features[~batch.frames].abs().max() == 0
    starts = batch.features[:, 0, 0].int().tolist()
    assert {start % 4 for start in starts} == {0, 1, 2, 3}  # a crop may begin at any frame
    # Away from the clip's ends the tokenizer sees the same frames in the crop as in the clip.
    for row in (batch.valid.sum(1) > 12).nonzero()[:4, 0].tolist():  # 13 and 14 tokens: clip b
        start, clip = starts[row], clips[1].features
        whole = tokenizer.encode(clip[None, start % 4 :][:, : (len(clip) - start % 4) // 4 * 4])
        first, count = start // 4, int(batch.valid[row].sum())
        assert torch.equal(batch.ids[row, :count], whole[0, first : first + count])


def test_a_third_of_the_crops_is_one_token_shorter(identity, tokenizer):
    torch.manual_seed(0)
    sampler = TokenSampler([clip_of("a", 80)], identity, tokenizer, TEXT, progress=False)
    lengths = sampler.sample(3000).valid.sum(1)
    assert set(lengths.tolist()) == {19, 20}
    share = (lengths == 19).float().mean().item()
    assert share == pytest.approx(1 / 3, abs=standard_error(1 / 3, 3000))


def test_captions_of_a_part_make_items_of_that_part(identity, tokenizer):
    torch.manual_seed(0)
    captions = (Caption("walks"), Caption("left", start=1.0, end=3.5), Caption("right", start=0.0, end=1.0))
    sampler = TokenSampler([clip_of("a", 100, *captions)], identity, tokenizer, TEXT, progress=False)
    assert len(sampler) == 2  # "right" speaks of 20 frames, too few
    seen = set()
    for batch in (sampler.sample(20) for _ in range(20)):  # a batch holds clips of similar length only
        (caption,) = set(batch.captions)
        first, last = {"walks": (0, 100), "left": (20, 70)}[caption]
        assert batch.features[:, 0, 0].min() >= first
        assert batch.features[..., 0].max() < last
        assert torch.equal(batch.text, TEXT[caption].expand(20, 4))
        seen.add(caption)
    assert seen == {"walks", "left"}


def test_a_batch_holds_clips_of_similar_length_and_every_clip_gets_its_turn(identity, tokenizer):
    torch.manual_seed(0)
    lengths = (40, 44, 100, 110, 196)
    clips = [clip_of(str(length), length, Caption("walks")) for length in lengths]
    sampler = TokenSampler(clips, identity, tokenizer, TEXT, progress=False)
    longest = set()
    for _ in range(60):
        tokens = sampler.sample(12).valid.sum(1)
        assert tokens.min() >= 0.7 * tokens.max()  # 15 % either way, and a third is a token shorter
        longest.add(int(tokens.max()))
    assert {11, 27, 49} <= longest


def test_rare_caption_kinds_are_not_drowned(identity, tokenizer):
    torch.manual_seed(0)
    captions = [Caption("walks", "template")] * 9 + [Caption("stops", "annotator")]
    sampler = TokenSampler([clip_of("a", 44, *captions)], identity, tokenizer, TEXT, progress=False)
    share = sum(text == "stops" for text in sampler.sample(1000).captions) / 1000
    assert share == pytest.approx(0.5, abs=standard_error(0.5, 1000))


def test_long_clips_are_cropped_to_the_longest_sequence(identity, tokenizer):
    sampler = TokenSampler([clip_of("a", 199)], identity, tokenizer, TEXT, progress=False)
    assert sampler.whole([0]).ids.shape == (1, 49, 3)


def test_clips_without_captions_or_length_are_refused(identity, tokenizer):
    clips = [clip_of("a", 39), clip_of("b", 200), FeatureClip("c", torch.zeros(60, 263), ())]
    with pytest.raises(ValueError, match="No clip of a split has a caption and 40 to 199 frames"):
        TokenSampler(clips, identity, tokenizer, TEXT, progress=False)


def test_layer_perplexity_counts_the_codes_in_use():
    """One code: 1. Four codes alike: 4. Shares 3/4 and 1/4: exp(-(3/4 ln 3/4 + 1/4 ln 1/4))."""
    ids = torch.tensor([[7, 0, 2], [7, 1, 2], [7, 2, 2], [7, 3, 5]])
    entropy = -(0.75 * math.log(0.75) + 0.25 * math.log(0.25))
    assert list(layer_perplexities(ids).values()) == pytest.approx([1.0, 4.0, math.exp(entropy)])
    assert list(layer_perplexities(ids)) == ["perplexity_0", "perplexity_1", "perplexity_2"]
