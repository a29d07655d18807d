"""gumbel_straight_through: noise against known answers, kernels against the specification."""

from dataclasses import dataclass

import pytest
import torch

from controlmm import ops
from controlmm.ops.philox import philox_4x32_10

# Two logarithms and an exponential of float32, against the same in float64; at low temperature the exponent's
# rounding is multiplied by 1 / temperature.
TOLERANCE = {torch.float32: {"rtol": 2e-5, "atol": 5e-6}, torch.float64: {"rtol": 1e-11, "atol": 1e-13}}

# Published with the generator (Random123, kat_vectors, philox4x32 with 10 rounds).
KNOWN_ANSWERS = [
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]


@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN_ANSWERS)
def test_philox_gives_the_published_words(counter, key, expected):
    words = philox_4x32_10(tuple(torch.tensor(word) for word in counter), key)
    assert tuple(word.item() for word in words) == expected


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("seed", [0, 12345, 2**64 - 1])
def test_noise_agrees_with_reference(seed, dtype, isa):
    actual = ops.gumbel_noise((2, 3, 515), seed=seed, first_clip=5, dtype=dtype, backend="native")
    expected = ops.gumbel_noise(
        (2, 3, 515), seed=seed, first_clip=5, dtype=torch.float64, backend="reference"
    )
    torch.testing.assert_close(actual.double(), expected, **TOLERANCE[dtype])


def test_noise_has_the_gumbel_distribution():
    noise = ops.gumbel_noise((8, 50, 512), seed=3, dtype=torch.float64).flatten()
    uniform = (-(-noise).exp()).exp()  # the distribution function of the standard Gumbel
    counts = torch.histc(uniform, bins=64, min=0, max=1)
    expected = noise.numel() / 64
    chi_squared = ((counts - expected) ** 2 / expected).sum().item()
    assert 30 < chi_squared < 110  # 63 degrees of freedom: mean 63, deviation 11


@dataclass(frozen=True)
class Case:
    name: str
    batch: int = 2
    tokens: int = 5
    codes: int = 64
    channels: int = 24
    temperature: float = 1.0
    hard: bool = True
    is_strided: bool = False

    def __str__(self):
        return self.name

    def arguments(self, dtype):
        generator = torch.Generator().manual_seed(31)
        logits = torch.randn(self.batch, self.tokens, self.codes, generator=generator, dtype=torch.float64)
        codebook = torch.randn(self.codes, self.channels, generator=generator, dtype=torch.float64)
        if self.is_strided:
            logits = logits.permute(2, 0, 1).contiguous().permute(1, 2, 0)
            codebook = codebook.T.contiguous().T
        return (logits * 2).to(dtype), codebook.to(dtype)

    @property
    def options(self):
        return {"temperature": self.temperature, "hard": self.hard, "seed": 9}


CASES = [
    Case("hard"),
    Case("soft", hard=False),
    Case("warm", temperature=5.0),
    Case("cool_soft", temperature=0.3, hard=False),
    Case("paper_size", tokens=3, codes=512, channels=512),
    Case("codes_not_whole_blocks", codes=513),
    Case("few_codes", codes=3),
    Case("one_code", codes=1),
    Case("strided", is_strided=True),
    Case("no_clip", batch=0),
    Case("no_token", tokens=0),
]


def run(logits, codebook, backend, **options):
    leaves = logits.detach().requires_grad_(), codebook.detach().requires_grad_()
    embeddings, ids = ops.gumbel_straight_through(*leaves, backend=backend, **options)
    weights = torch.randn(embeddings.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    gradients = torch.autograd.grad(embeddings, leaves, weights.to(embeddings.dtype))
    return embeddings.detach(), ids, *gradients


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("case", CASES, ids=str)
def test_agrees_with_reference(case, dtype, isa):
    logits, codebook = case.arguments(dtype)
    actual = run(logits, codebook, "native", **case.options)
    expected = run(logits.double(), codebook.double(), "reference", **case.options)
    assert torch.equal(actual[1], expected[1])
    for mine, reference in zip(actual, expected, strict=True):
        torch.testing.assert_close(mine.to(reference.dtype), reference, **TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("hard", [True, False])
@pytest.mark.parametrize("backend", ["native", "reference"])
def test_lowest_temperature_is_the_drawn_code_without_nan(backend, hard, dtype, isa):
    logits, codebook = Case("cold").arguments(dtype)
    embeddings, ids, *gradients = run(logits, codebook, backend, temperature=1e-8, seed=9, hard=hard)
    torch.testing.assert_close(embeddings, codebook[ids])
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_hard_embeddings_are_exact_rows_and_do_not_depend_on_the_temperature(isa):
    logits, codebook = Case("paper_size", codes=512).arguments(torch.float32)
    first, ids = ops.gumbel_straight_through(logits, codebook, seed=1, temperature=0.1, backend="native")
    second, same = ops.gumbel_straight_through(logits, codebook, seed=1, temperature=9, backend="native")
    assert torch.equal(first, codebook[ids])
    assert torch.equal(ids, same)
    assert torch.equal(first, second)


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_a_split_batch_draws_the_same_codes(backend, isa):
    logits, codebook = Case("batch", batch=5).arguments(torch.float32)
    whole = ops.gumbel_straight_through(logits, codebook, seed=7, backend=backend)
    tail = ops.gumbel_straight_through(logits[3:], codebook, seed=7, first_clip=3, backend=backend)
    assert torch.equal(whole[1][3:], tail[1])
    assert torch.equal(whole[0][3:], tail[0])


def test_codes_follow_the_softmax():
    logits = torch.tensor([0.0, 1.0, 2.0, -1.0]).expand(40, 500, 4)
    _, ids = ops.gumbel_straight_through(logits, torch.eye(4), seed=2)
    observed = torch.bincount(ids.flatten(), minlength=4) / ids.numel()
    # Twenty thousand draws: standard deviation at most 0.0036.
    torch.testing.assert_close(observed, logits[0, 0].softmax(-1), rtol=0, atol=0.015)


def test_gradcheck_of_the_soft_path(isa):
    logits, codebook = Case("small", batch=1, tokens=2, codes=5, channels=3).arguments(torch.float64)
    torch.autograd.gradcheck(
        lambda x, c: ops.gumbel_straight_through(x, c, seed=3, temperature=0.8, hard=False, backend="native")[
            0
        ],
        (logits.requires_grad_(), codebook.requires_grad_()),
    )


def test_every_instruction_set_gives_the_same_bits():
    logits, codebook = Case("paper_size", codes=512, channels=8).arguments(torch.float32)
    results = []
    for isa in ops.available_isas():
        with ops.use_isa(isa):
            results.append(
                (
                    ops.gumbel_noise((2, 3, 100), seed=5, backend="native"),
                    *run(logits, codebook, "native", seed=1, temperature=0.7),
                )
            )
    for result in results[1:]:
        for mine, first in zip(result, results[0], strict=True):
            assert torch.equal(mine, first)


def test_impossible_arguments_are_refused():
    logits, codebook = Case("hard").arguments(torch.float32)
    with pytest.raises(ValueError, match="`temperature` must be at least 1e-8, got 0"):
        ops.gumbel_straight_through(logits, codebook, temperature=0, seed=0)
    with pytest.raises(ValueError, match=r"`seed` must be between 0 and 2\*\*64 - 1, got -1"):
        ops.gumbel_straight_through(logits, codebook, seed=-1)
    with pytest.raises(ValueError, match=r"`logits` must have shape \(B, L, K\) and `codebook` \(K, C\)"):
        ops.gumbel_straight_through(logits, codebook[1:], seed=0)
    with pytest.raises(TypeError, match="must share one floating-point dtype"):
        ops.gumbel_straight_through(logits, codebook.double(), seed=0)
