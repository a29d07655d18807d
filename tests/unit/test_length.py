"""Lengths that nobody gave: what the estimator is trained on, how a length is drawn, who asks for one."""

from __future__ import annotations

import math
import warnings

import pytest
import torch

from controlmm.controls import JointControl, PathControl
from controlmm.data import Caption, FeatureClip
from controlmm.models.length_estimator import LengthEstimator, LengthEstimatorConfig
from controlmm.motion.skeleton import HUMANML3D
from controlmm.pipelines import ControlMM
from controlmm.pipelines.length import draw_frames, frames_needed
from controlmm.training.length import LengthPairs, LengthRecipe

SIGMAS = 4.5


class Scripted(LengthEstimator):
    """An estimator with the same given probabilities for every text."""

    def __init__(self, probabilities: dict[int, float], text_dim: int = 64) -> None:
        super().__init__(LengthEstimatorConfig(text_dim=text_dim, width=16))
        logits = torch.full((50,), -1e9)
        for tokens, probability in probabilities.items():
            logits[tokens] = math.log(probability)
        self.scripted = logits

    def forward(self, text):
        return self.scripted.expand(len(text), -1)


def drawn(estimator, *, seed=0, controls=()):
    return draw_frames(
        estimator,
        torch.zeros(1, 64),
        controls=controls,
        skeleton=HUMANML3D,
        max_frames=196,
        downsample=4,
        seed=seed,
    )


def test_the_published_size():
    network = LengthEstimator(LengthEstimatorConfig.paper())
    assert round(sum(p.numel() for p in network.parameters()) / 1e6, 3) == 0.435


@pytest.mark.parametrize("changes", [{"width": 6}, {"width": 0}, {"classes": 1}])
def test_impossible_sizes_are_refused(changes):
    with pytest.raises(ValueError, match="`width` must be a multiple of 4 and `classes` at least 2"):
        LengthEstimatorConfig(**changes)


def test_lengths_are_drawn_with_their_probabilities():
    estimator, count = Scripted({10: 0.25, 30: 0.75}), 1000
    lengths = [drawn(estimator, seed=seed) for seed in range(count)]
    assert set(lengths) == {40, 120}
    share = lengths.count(120) / count
    assert share == pytest.approx(0.75, abs=SIGMAS * math.sqrt(0.75 * 0.25 / count))
    assert drawn(estimator, seed=3) == drawn(estimator, seed=3)


def test_a_drawn_length_holds_every_control():
    estimator = Scripted({10: 0.9, 20: 0.05, 40: 0.05})
    control = JointControl("head", frames=[3, 80], positions=[[0, 1.5, 0]] * 2)
    assert frames_needed(control, HUMANML3D) == 81
    assert {drawn(estimator, seed=seed, controls=[control]) for seed in range(20)} == {160}
    spread = PathControl("pelvis", xz=[[0, 0], [0, 2]])
    assert frames_needed(spread, HUMANML3D) == 8


def test_when_no_length_holds_the_controls_the_shortest_that_does_is_taken():
    control = JointControl("head", frames=[195], positions=[[0, 1.5, 0]])
    estimator = Scripted({10: 1.0})
    estimator.scripted = torch.zeros(40)  # an estimator whose longest motion has 39 tokens
    assert drawn(estimator, controls=[control]) == 196


def test_lengths_that_no_motion_can_have_are_not_drawn():
    with pytest.warns(UserWarning, match="drew 0.4 s"):
        assert drawn(Scripted({0: 0.5, 1: 0.4, 2: 0.1})) == 8


def test_a_very_short_length_is_warned_of():
    with pytest.warns(
        UserWarning, match=r"drew 1\.0 s for this prompt, which is very short\. Pass `seconds`"
    ):
        assert drawn(Scripted({5: 1.0})) == 20
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert drawn(Scripted({8: 1.0})) == 32


def with_length(pipeline: ControlMM, estimator: LengthEstimator) -> ControlMM:
    return ControlMM(
        tokenizer=pipeline.decoder.tokenizer,
        transformer=pipeline.transformer,
        residual=pipeline.residual,
        control=pipeline.control,
        normalizer=pipeline.decoder.normalizer,
        text_encoder=pipeline.text_encoder,
        length=estimator,
    )


def test_a_pipeline_with_an_estimator_draws_the_length_nobody_gave(tiny_pipeline):
    pipeline = with_length(tiny_pipeline, Scripted({10: 1.0}))
    assert pipeline("a person walks", preset="fast").best.num_frames == 40
    assert pipeline("a person walks", frames=16, preset="fast").best.num_frames == 16
    assert pipeline("a person walks", seconds=1.0, preset="fast").best.num_frames == 20
    assert tiny_pipeline("a person walks", preset="fast").best.num_frames == 120


def test_a_bad_call_is_refused_before_the_text_encoder_runs(tiny_pipeline, monkeypatch):
    pipeline = with_length(tiny_pipeline, Scripted({10: 1.0}))
    monkeypatch.setattr(pipeline.text_encoder, "encode", lambda _: pytest.fail("the text encoder ran"))
    control = JointControl("head", frames=[300], positions=[[0, 1.5, 0]])
    with pytest.raises(ValueError, match="300"):
        pipeline("a person walks", controls=[control])


def test_the_estimator_is_saved_and_loaded_with_the_pipeline(tiny_pipeline, tmp_path):
    torch.manual_seed(0)
    estimator = LengthEstimator(LengthEstimatorConfig.tiny())
    with_length(tiny_pipeline, estimator).save_pretrained(tmp_path / "with")
    loaded = ControlMM.from_pretrained(tmp_path / "with").length
    text = torch.ones(1, 64)
    assert torch.equal(loaded(text), estimator.eval()(text))
    tiny_pipeline.save_pretrained(tmp_path / "without")
    assert ControlMM.from_pretrained(tmp_path / "without").length is None


def test_an_estimator_for_another_text_encoder_is_refused(tiny_pipeline):
    with pytest.raises(ValueError, match="`text_dim` of `length` must be 64, got 32"):
        with_length(tiny_pipeline, LengthEstimator(LengthEstimatorConfig(text_dim=32, width=16)))


# --- training ---


def clip(name: str, frames: int, *captions: Caption) -> FeatureClip:
    return FeatureClip(name, torch.zeros(frames, 263), captions, "lab")


def test_every_caption_with_a_usable_length_is_a_pair():
    clips = [
        clip("a", 101, Caption("walks"), Caption("turns", start=1.0, end=4.0)),
        clip("short", 39, Caption("walks")),
        clip("long", 200, Caption("walks"), Caption("sits", start=8.0, end=99.0)),
        clip("longest", 199, Caption("walks")),
    ]
    text = {name: torch.tensor([float(i)]) for i, name in enumerate(("walks", "turns", "sits"))}
    pairs = LengthPairs.of_clips(clips, text, most=48)
    # 101 // 4, 3 s of 20 fps, 8 s to the end of 10 s, 199 // 4 = 49 and at most 48
    assert pairs.tokens.tolist() == [25, 15, 10, 48]
    assert pairs.text[:, 0].tolist() == [0, 1, 2, 0]
    assert pairs.weights[0] * 2 == pairs.weights[3]
    with pytest.raises(ValueError, match="No clip has a caption and a usable length"):
        LengthPairs.of_clips(clips[1:2], text, most=49)


def test_the_recipe_learns_lengths_by_text():
    torch.manual_seed(0)
    pairs = LengthPairs(torch.eye(64)[:2], torch.tensor([12, 40]), torch.ones(2))
    recipe = LengthRecipe(LengthEstimatorConfig(text_dim=64, width=64, dropout=0.0), pairs, pairs)
    optimizer = torch.optim.AdamW(recipe.model.parameters(), lr=1e-2)
    before = recipe.validate()
    for _ in range(60):
        optimizer.zero_grad()
        recipe.loss(8)["loss"].backward()
        optimizer.step()
    after = recipe.validate()
    assert after["score"] < 0.1 < before["score"]
    assert after["frames_off"] < 4
    assert recipe.model(pairs.text).argmax(-1).tolist() == [12, 40]
