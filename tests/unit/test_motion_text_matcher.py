"""The in-project evaluator's network, its pairs and its loss."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from controlmm.data import Caption, FeatureClip
from controlmm.models.motion_text_matcher import MatcherConfig, MotionTextMatcher
from controlmm.motion.features import canonicalize, joints_to_features
from controlmm.motion.mirror import mirror_features
from controlmm.motion.normalizer import Normalizer
from controlmm.text.hashing import HashingTextEncoder
from controlmm.training.evaluator import contrastive_loss
from controlmm.training.matching_pairs import PairSampler, sure_negatives

ROUNDING = 2e-5  # of float32 embeddings of length 10 through a recurrent network
ENCODER = HashingTextEncoder(64)


@pytest.fixture
def matcher(walk: Callable[..., torch.Tensor]) -> MotionTextMatcher:
    clips = [joints_to_features(canonicalize(walk(50, turn=turn))).float() for turn in (-1.0, 0.2, 1.5)]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        config = MatcherConfig.tiny().for_data(263, ENCODER.config())
        return MotionTextMatcher(config, Normalizer.fit(clips)).eval()


def _features(walk: Callable[..., torch.Tensor], frames: int, *, turn: float = 0.5) -> torch.Tensor:
    return joints_to_features(canonicalize(walk(frames + 1, turn=turn))).float()


@torch.no_grad()
def test_padding_and_batch_do_not_change_an_embedding(
    matcher: MotionTextMatcher, walk: Callable[..., torch.Tensor]
) -> None:
    short, long = _features(walk, 40), _features(walk, 80)
    alone = matcher.embed_motions(short[None], torch.tensor([40]))
    batch = torch.full((2, 100, 263), 1e3)  # whatever is in the padding
    batch[0, :80], batch[1, :40] = long, short
    together = matcher.embed_motions(batch, torch.tensor([80, 40]))
    torch.testing.assert_close(together[1:], alone, rtol=0, atol=ROUNDING)


@torch.no_grad()
def test_rows_keep_their_order_whatever_the_lengths(
    matcher: MotionTextMatcher, walk: Callable[..., torch.Tensor]
) -> None:
    clips = [_features(walk, frames) for frames in (24, 60, 44)]
    batch = torch.nn.utils.rnn.pad_sequence(clips, batch_first=True)
    found = matcher.embed_motions(batch, torch.tensor([24, 60, 44]))
    for row, clip in zip(found, clips, strict=True):
        alone = matcher.embed_motions(clip[None], torch.tensor([len(clip)]))
        torch.testing.assert_close(row[None], alone, rtol=0, atol=ROUNDING)


@torch.no_grad()
def test_contact_channels_and_a_rest_below_a_snippet_have_no_influence(
    matcher: MotionTextMatcher, walk: Callable[..., torch.Tensor]
) -> None:
    features = _features(walk, 43)[None]
    expected = matcher.embed_motions(features, torch.tensor([40]))
    features[..., -4:] = 7.0
    features[:, 40:] = 7.0
    assert torch.equal(matcher.embed_motions(features, torch.tensor([43])), expected)


@torch.no_grad()
def test_embeddings_lie_on_one_sphere(matcher: MotionTextMatcher, walk: Callable[..., torch.Tensor]) -> None:
    motions = matcher.embed_motions(_features(walk, 40)[None], torch.tensor([40]))
    texts = matcher.embed_texts(ENCODER.encode(["a person walks", "someone waves"]).pooled)
    torch.testing.assert_close(torch.cat([motions, texts]).norm(dim=-1), torch.full((3,), 10.0))


def test_statistics_and_text_encoder_travel_with_the_weights(
    matcher: MotionTextMatcher, tmp_path: Path
) -> None:
    matcher.save_pretrained(tmp_path)
    loaded = MotionTextMatcher.from_pretrained(tmp_path)
    assert torch.equal(loaded.normalizer.std, matcher.normalizer.std)
    assert loaded.config == matcher.config
    assert loaded.config.text_encoder == ENCODER.config()


def test_impossible_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="Sizes must be positive"):
        MatcherConfig(width=0)
    with pytest.raises(ValueError, match=r"`dropout` must be in \[0, 1\), got 1"):
        MatcherConfig(dropout=1)


def test_sentences_that_may_mean_the_same_are_no_negatives() -> None:
    text = torch.tensor([[1.0, 0.0], [0.9, 0.1], [0.0, 1.0]])
    found = sure_negatives(text, ["a person walks", "someone walks", "someone sits"])
    assert found.tolist() == [[False, False, True], [False, False, True], [True, True, False]]


def test_left_and_right_are_negatives_however_alike_the_sentences() -> None:
    text = torch.ones(3, 2)
    found = sure_negatives(text, ["waves the left hand", "waves the right hand", "waves a hand"])
    assert found.tolist() == [[False, True, False], [True, False, False], [False, False, False]]


def test_loss_of_two_pairs_by_hand() -> None:
    scores = torch.tensor([[2.0, 0.0], [1.0, 3.0]])
    negatives = ~torch.eye(2, dtype=torch.bool)
    per_text = math.log(1 + math.exp(-2)) + math.log(1 + math.exp(-2))
    per_motion = math.log(1 + math.exp(-1)) + math.log(1 + math.exp(-3))
    expected = (per_text / 2 + per_motion / 2) / 2
    assert contrastive_loss(scores, negatives).item() == pytest.approx(expected)
    assert contrastive_loss(scores, torch.zeros(2, 2, dtype=torch.bool)).item() == 0


def _clips(walk: Callable[..., torch.Tensor]) -> list[FeatureClip]:
    left = _features(walk, 50)
    return [
        FeatureClip("a", left, (Caption("turns left", "template"), Caption("walks", "written")), "x"),
        FeatureClip("Ma", mirror_features(left), (Caption("turns right", "template"),), "x"),
        FeatureClip("b", _features(walk, 30), (Caption("strolls", "written"),), "y"),
        FeatureClip("short", left[:20], (Caption("walks", "written"),), "x"),
        FeatureClip("mute", left, (), "x"),
    ]


def _texts(*captions: str) -> dict[str, torch.Tensor]:
    return dict(zip(captions, ENCODER.encode(captions).pooled, strict=True))


def test_a_batch_holds_the_mirrored_twin_of_what_it_drew(walk: Callable[..., torch.Tensor]) -> None:
    sampler = PairSampler(_clips(walk), _texts("turns left", "turns right", "walks", "strolls"))
    assert len(sampler) == 3
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        lengths = [sampler.sample(2).lengths.tolist() for _ in range(20)]
    assert all(pair in ([48, 48], [28]) for pair in lengths)  # 50 and 30 frames in whole units
    assert [48, 48] in lengths  # "a" or "Ma" was drawn
    assert [28] in lengths  # "b" has no twin


def test_kinds_choose_captions_and_an_empty_choice_is_named(walk: Callable[..., torch.Tensor]) -> None:
    texts = _texts("turns left", "turns right", "walks", "strolls")
    assert len(PairSampler(_clips(walk), texts, kinds=("written",))) == 2
    with pytest.raises(ValueError, match="No clip has 24 frames and a caption of the kinds kinematic"):
        PairSampler(_clips(walk), texts, kinds=("kinematic",))
