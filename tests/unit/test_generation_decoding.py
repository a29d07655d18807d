"""Masked decoding: schedule, guidance, confidence, residual layers, random numbers."""

from __future__ import annotations

import math

import pytest
import torch

from controlmm.generation.decoding_request import DecodingRequest
from controlmm.generation.guided_logits import base_prediction, guided, residual_prediction
from controlmm.generation.masked_decoding import (
    decode_from_text,
    fill_residual_layers,
    lowest,
    masked_counts,
)
from controlmm.generation.noise import ClipNoise, clip_seeds
from controlmm.models.rvq_vae import frame_mask

EULER_GAMMA = 0.57721566  # mean of the standard Gumbel distribution; its variance is pi^2 / 6


def request(
    lengths: list[int], *, steps: int = 10, scale: float = 4.0, seed: int = 0, **options
) -> DecodingRequest:
    generator = torch.Generator().manual_seed(3)
    return DecodingRequest(
        torch.randn(len(lengths), 64, generator=generator),
        frame_mask(torch.tensor(lengths), max(lengths)),
        ClipNoise(clip_seeds(seed, len(lengths))),
        steps=steps,
        guidance_scale=scale,
        **options,
    )


def test_hidden_counts_follow_the_cosine_schedule():
    """max(1, round(cos(pi t / 2) n)) for n = 49 and t = 0, 1/9, ..., 1, worked out by hand."""
    counts = [masked_counts(request([49]), step).item() for step in range(10)]
    assert counts == [49, 48, 46, 42, 38, 31, 24, 17, 9, 1]


@pytest.mark.parametrize(("steps", "expected"), [(1, [10]), (2, [10, 1]), (3, [10, 7, 1])])
def test_schedules_of_few_steps_begin_with_all_and_end_with_one(steps, expected):
    few = request([10, 2], steps=steps)
    assert [masked_counts(few, step)[0].item() for step in range(steps)] == expected
    assert masked_counts(few, steps - 1)[1] == (2 if steps == 1 else 1)


def test_lowest_scores_are_found_for_each_clip_and_ties_go_by_position():
    scores = torch.tensor([[0.3, 0.1, 0.2, 9.0], [0.5, 0.5, 0.5, 0.5]])
    hidden = lowest(scores, torch.tensor([2, 3]))
    assert hidden.tolist() == [[False, True, True, False], [True, True, True, False]]


def test_guidance_moves_away_from_the_prediction_without_text():
    asked = request([3], scale=4.0)

    def predict(rows, valid, text):
        return text.sum(1)[:, None, None] * torch.ones(*valid.shape, 2) + 1.0

    row = torch.tensor([0])
    with_text, without = (predict(row, asked.valid, text) for text in (asked.text, torch.zeros(1, 64)))
    torch.testing.assert_close(guided(predict, asked), without + 4 * (with_text - without))
    torch.testing.assert_close(guided(predict, asked, scale=1.0), with_text)
    torch.testing.assert_close(guided(predict, asked, scale=0.0), without)


def test_gumbel_noise_has_the_gumbel_moments():
    draws = 200_000
    noise = ClipNoise([5]).gumbel([draws // 100], padded=draws // 100, width=100)
    deviation = math.pi / math.sqrt(6)
    assert noise.mean().item() == pytest.approx(EULER_GAMMA, abs=4.5 * deviation / math.sqrt(draws))
    assert noise.std().item() == pytest.approx(deviation, rel=0.02)
    assert torch.isfinite(noise).all()


def test_noise_of_a_clip_depends_on_its_seed_alone():
    together = ClipNoise([1, 2, 3])
    alone = ClipNoise([2])
    for _ in range(2):  # streams go on from call to call
        batch = together.gumbel([5, 3, 4], padded=5, width=8)
        assert torch.equal(batch[1, :3], alone.gumbel([3], padded=3, width=8)[0])
        assert batch[1, 3:].abs().max() == 0
        assert not torch.equal(batch[0, :3], batch[1, :3])


def test_seeds_of_samples_do_not_depend_on_their_number_and_all_differ():
    assert clip_seeds(7, 3) == clip_seeds(7, 10)[:3]
    seeds = [seed for run in range(50) for seed in clip_seeds(run, 20)]
    assert len(set(seeds)) == 1000
    assert all(0 <= seed < 2**63 for seed in clip_seeds(2**80, 4))


@pytest.mark.parametrize("steps", [1, 2, 10])
def test_text_decoding_gives_a_code_to_every_valid_position(tiny_pipeline, steps):
    asked = request([9, 4], steps=steps)
    ids = decode_from_text(tiny_pipeline.transformer, asked)
    assert ((ids >= 0) & (ids < 32))[asked.valid].all()
    assert (ids[~asked.valid] == -1).all()


def test_text_decoding_draws_only_from_the_likeliest_tenth(tiny_pipeline):
    """With one step every id comes from the first logits, of which ceil(0.1 * 32) = 4 can be drawn."""
    transformer, asked = tiny_pipeline.transformer, request([12], steps=1)
    hidden = transformer.embed(torch.full((1, 12), transformer.mask_id))
    logits = guided(base_prediction(transformer, hidden), asked)
    ids = decode_from_text(transformer, asked)
    assert (logits.topk(4, dim=-1).indices == ids[..., None]).any(-1).all()


def test_progress_is_told_after_every_step(tiny_pipeline):
    calls = []
    asked = request([4], steps=3, progress=lambda *call: calls.append(call))
    decode_from_text(tiny_pipeline.transformer, asked)
    assert calls == [("masked decoding", done, 3) for done in (1, 2, 3)]


def test_residual_layers_are_the_likeliest_codes_given_the_layers_before(tiny_pipeline):
    residual, asked = tiny_pipeline.residual, request([6, 3])
    base = torch.where(asked.valid, torch.arange(12).view(2, 6), -1)
    ids = fill_residual_layers(residual, base, asked, guidance_scale=5.0)
    assert torch.equal(ids[..., 0], base)
    assert (ids[~asked.valid] == -1).all()
    for layer in (1, 2):
        number = torch.full((2,), layer)
        known = torch.where(torch.arange(3) < layer, ids, -1)
        predict = residual_prediction(residual, residual.history(known, number), number, None)
        logits = guided(predict, asked, scale=5.0)
        expected = logits[..., :32].argmax(-1)  # PAD, number 32, is never a choice
        assert torch.equal(ids[..., layer][asked.valid], expected[asked.valid])
