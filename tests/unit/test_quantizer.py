"""Residual quantisation against plain loops."""

from __future__ import annotations

import copy
import math

import pytest
import torch

from controlmm.nn.quantizer import EmaCodebook, ResidualQuantizer

DECAY = 0.9
ROUNDING = 1e-5  # float32 sums of a few dozen numbers in another order


def make_quantizer(layers: int = 3, *, codes: int = 8, dim: int = 4, **changes) -> ResidualQuantizer:
    options = {"shared": False, "temperature": 0.5, "dropout": 0.0, "decay": DECAY} | changes
    quantizer = ResidualQuantizer(num_quantizers=layers, num_codes=codes, dim=dim, **options)
    generator = torch.Generator().manual_seed(1)
    for book in quantizer.books:
        book.codes.normal_(generator=generator)
        book.ema_sum.copy_(book.codes)
        book.is_initialized.fill_(True)
    return quantizer


def vectors(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_every_layer_takes_the_nearest_code_of_what_is_left():
    quantizer, x = make_quantizer().eval(), vectors(2, 5, 4)
    result = quantizer(x)
    for clip, token in ((0, 0), (1, 4)):
        residual = x[clip, token].clone()
        for layer in range(3):
            codes = quantizer.book(layer).codes
            nearest = min(range(8), key=lambda k, r=residual, c=codes: float((r - c[k]).square().sum()))
            assert result.ids[clip, token, layer] == nearest
            residual -= codes[nearest]
        torch.testing.assert_close(result.latents[clip, token], x[clip, token] - residual)


def test_lookup_of_the_ids_gives_the_latents():
    quantizer = make_quantizer().eval()
    result = quantizer(vectors(2, 5, 4))
    torch.testing.assert_close(quantizer.lookup(result.ids), result.latents, rtol=0, atol=ROUNDING)
    assert quantizer.lookup(torch.full((1, 2, 3), -1)).abs().max() == 0


@pytest.mark.parametrize("layers", [1, 3])
def test_gradient_passes_straight_through_once_for_each_layer(layers):
    quantizer, x = make_quantizer(layers).eval(), vectors(2, 5, 4).requires_grad_()
    (gradient,) = torch.autograd.grad(quantizer(x).latents.sum(), x)
    assert torch.equal(gradient, torch.full_like(x, float(layers)))


def test_commitment_is_the_mean_distance_over_the_layers():
    quantizer, x = make_quantizer().eval(), vectors(2, 5, 4)
    result, residual, expected = quantizer(x), x, []
    for layer in range(3):
        residual = residual - quantizer.lookup_layer(result.ids[..., layer], layer)
        expected.append(residual.square().mean())
    torch.testing.assert_close(result.commitment, torch.stack(expected).mean(), rtol=ROUNDING, atol=0)


def test_perplexity_counts_the_codes_in_use():
    quantizer = make_quantizer(1).eval()
    x = quantizer.book(0).codes[:4].expand(3, 4, 4)  # four codes, equally often
    assert quantizer(x).perplexity == pytest.approx(4, rel=1e-4)


def test_codes_follow_the_exponential_mean_of_their_vectors():
    book = EmaCodebook(3, 2, decay=DECAY)
    start = torch.tensor([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])
    book.codes.copy_(start)
    book.ema_sum.copy_(start * 10)
    book.ema_count.fill_(10.0)
    x, ids = vectors(6, 2), torch.tensor([0, 0, 1, 0, 2, 1])
    book.update(x, ids)
    for code in range(3):
        mine = [x[i] for i in range(6) if ids[i] == code]
        total = DECAY * 10 * start[code] + (1 - DECAY) * sum(mine)
        count = DECAY * 10 + (1 - DECAY) * len(mine)
        torch.testing.assert_close(book.codes[code], total / count, rtol=ROUNDING, atol=ROUNDING)
        assert book.ema_count[code] == pytest.approx(count)


def test_dead_codes_become_vectors_of_the_batch():
    torch.manual_seed(0)
    book = EmaCodebook(4, 2, decay=DECAY)
    book.codes.fill_(100.0)
    book.ema_sum.fill_(500.0)
    book.ema_count.copy_(torch.tensor([5.0, 0.5, 5.0, 0.5]))
    x = vectors(9, 2)
    book.update(x, torch.tensor([0] * 5 + [2] * 4))
    assert all((book.codes[code] == x).all(1).any() for code in (1, 3))
    assert not any((book.codes[code] == x).all(1).any() for code in (0, 2))


def test_the_first_batch_gives_the_codes_even_when_it_is_small():
    torch.manual_seed(0)
    book = EmaCodebook(8, 2, decay=DECAY)
    x = vectors(3, 2)
    book.initialize(x)
    spread = torch.cdist(book.codes, x).amin(1)
    assert spread.max() < 0.1  # repeated with noise of deviation 0.01 / sqrt(2)
    assert len(book.codes.unique(dim=0)) == 8
    assert book.is_initialized


def test_padding_never_enters_the_codebooks():
    x, valid = vectors(2, 6, 4), torch.tensor([[True] * 6, [True] * 2 + [False] * 4])
    states = []
    for filler in (0.0, 1e6):
        quantizer = make_quantizer().train()
        torch.manual_seed(3)
        result = quantizer(torch.where(valid[..., None], x, filler), valid)
        assert (result.ids[~valid] == -1).all()
        assert (result.ids[valid] >= 0).all()
        assert result.latents[~valid].abs().max() == 0
        states.append(quantizer.state_dict())
    for name in states[0]:
        assert torch.equal(states[0][name], states[1][name]), name


def test_padding_does_not_count_in_commitment_and_perplexity():
    quantizer, x = make_quantizer().eval(), vectors(1, 5, 4)
    alone = quantizer(x)
    padded = quantizer(
        torch.cat([x, torch.full((1, 3, 4), 9.0)], dim=1), torch.tensor([[True] * 5 + [False] * 3])
    )
    torch.testing.assert_close(padded.commitment, alone.commitment)
    torch.testing.assert_close(padded.perplexity, alone.perplexity)


def test_the_whole_state_is_saved_and_restored():
    quantizer = make_quantizer().train()
    torch.manual_seed(0)
    quantizer(vectors(4, 6, 4))
    restored = make_quantizer()
    restored.load_state_dict(quantizer.state_dict())
    restored.train()
    continued = []
    for one in (quantizer, restored):
        torch.manual_seed(1)
        one(vectors(4, 6, 4, seed=2))
        continued.append(one.state_dict())
    assert {name.rpartition(".")[2] for name in continued[0]} == {
        "codes",
        "ema_sum",
        "ema_count",
        "is_initialized",
    }
    assert all(torch.equal(continued[0][name], continued[1][name]) for name in continued[0])


def test_evaluation_is_deterministic_and_changes_nothing():
    quantizer = make_quantizer(dropout=1.0).eval()
    before = copy.deepcopy(quantizer.state_dict())
    torch.manual_seed(0)
    first = quantizer(vectors(2, 5, 4)).ids
    assert torch.equal(quantizer(vectors(2, 5, 4)).ids, first)
    assert (first >= 0).all()
    assert all(torch.equal(before[name], value) for name, value in quantizer.state_dict().items())


def test_training_draws_codes_by_their_distance():
    """Frequencies of 20 000 draws against softmax(-distance / temperature), four standard errors wide."""
    torch.manual_seed(0)
    book = EmaCodebook(3, 1, decay=DECAY)
    book.codes.copy_(torch.tensor([[0.0], [0.5], [1.0]]))
    x, draws = torch.full((20_000, 1), 0.2), 20_000
    shares = torch.bincount(book.nearest(x, temperature=0.5), minlength=3) / draws
    expected = torch.softmax(-torch.tensor([0.04, 0.09, 0.64]) / 0.5, dim=0)
    assert (shares - expected).abs().max() < 4 * math.sqrt(0.25 / draws)


def test_quantise_dropout_skips_a_random_number_of_last_layers():
    torch.manual_seed(0)
    quantizer = make_quantizer(dropout=1.0).train()
    used = []
    for _ in range(60):
        ids = quantizer(vectors(1, 4, 4)).ids[0]
        active = (ids >= 0).all(0)
        assert torch.equal(active, (ids >= 0).any(0))
        used.append(int(active.sum()))
        assert active.tolist() == [layer < used[-1] for layer in range(3)]
    assert set(used) == {1, 2, 3}


def test_a_shared_codebook_serves_all_layers():
    quantizer = make_quantizer(shared=True).eval()
    assert len(quantizer.books) == 1
    assert quantizer.book(0) is quantizer.book(2)
    assert quantizer(vectors(1, 3, 4)).ids.shape == (1, 3, 3)
