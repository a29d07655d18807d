"""Winograd's filtering: kernels against their twins and against convolutions, the same bits everywhere."""

import itertools
from dataclasses import dataclass

import pytest
import torch

from controlmm import ops

# A sum of six terms with factors up to 8, and what single terms of order one can leave of it.
TOLERANCE = {torch.float32: 2e-5, torch.float64: 1e-13}
# Of a convolution of unit gain: with 192 channels float32 errs by 5e-7 on average, by 6e-6 at most.
CONVOLUTION = {torch.float32: 2e-5, torch.float64: 1e-13}


def random(*shape, seed, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


@dataclass(frozen=True)
class Case:
    lengths: tuple[int, ...]
    distance: int
    inputs: int
    outputs: int
    dtype: torch.dtype = torch.float32

    def __str__(self):
        lengths = "_".join(map(str, self.lengths)) or "none"
        return f"{lengths}-{self.distance}-{self.inputs}-{self.outputs}-{str(self.dtype)[6:]}"

    @property
    def tiles(self):
        return ops.WinogradTiles.of(self.lengths, self.distance)

    @property
    def x(self):
        return random(sum(self.lengths), self.inputs, seed=1, dtype=self.dtype)

    @property
    def weight(self):
        weight = random(self.outputs, self.inputs, 3, seed=2, dtype=self.dtype)
        return weight / (3 * self.inputs) ** 0.5

    @property
    def bias(self):
        return random(self.outputs, seed=3, dtype=self.dtype)

    @property
    def products(self):
        return random(6, len(self.tiles), self.outputs, seed=4, dtype=self.dtype)


SIZES = [
    ((), 1, 3, 3), ((1,), 1, 1, 1), ((2, 0, 5), 3, 16, 17), ((4,), 1, 33, 15), ((51,), 9, 48, 32),
    ((102, 96, 13), 3, 40, 64), ((7, 8, 9), 30, 5, 20),
]  # fmt: skip
CASES = [Case(*size, dtype) for size, dtype in itertools.product(SIZES, TOLERANCE)]
cases = pytest.mark.parametrize("case", CASES, ids=str)


@cases
def test_kernels_do_what_their_twins_do(isa, case):
    kinds = {"rtol": 0, "atol": TOLERANCE[case.dtype]}
    parts = [ops.winograd_parts(case.x, case.tiles, backend=name) for name in ("native", "reference")]
    torch.testing.assert_close(*parts, **kinds)
    for bias, is_rectified in itertools.product((case.bias, None), (True, False)):
        frames = [
            ops.winograd_frames(case.products, case.tiles, bias, is_rectified=is_rectified, backend=name)
            for name in ("native", "reference")
        ]
        torch.testing.assert_close(*frames, **kinds)
        assert not is_rectified or (frames[0] >= 0).all()


@pytest.mark.parametrize("backend", ["auto", "reference"])
@cases
def test_a_convolution(case, backend):
    """Compared in float64 with one clip after the other."""
    parts = ops.winograd_parts(case.x, case.tiles, backend=backend)
    products = parts @ ops.winograd_weights(case.weight).mT
    y = ops.winograd_frames(products, case.tiles, case.bias, backend=backend)
    clips = [
        torch.nn.functional.conv1d(
            clip.T.double(), case.weight.double(), case.bias.double(), padding=case.distance,
            dilation=case.distance,
        ).T
        for clip in case.x.split(case.lengths) if len(clip)
    ]  # fmt: skip
    expected = torch.cat([y.new_zeros(0, case.outputs).double(), *clips])
    torch.testing.assert_close(y.double(), expected, rtol=0, atol=CONVOLUTION[case.dtype])


@pytest.mark.skipif(len(ops.available_isas()) < 2, reason="there is one instruction set")
@cases
def test_all_instruction_sets_agree_to_the_bit(case):
    results = []
    for name in ops.available_isas():
        with ops.use_isa(name):
            parts = ops.winograd_parts(case.x, case.tiles, backend="native")
            frames = ops.winograd_frames(
                case.products, case.tiles, case.bias, is_rectified=True, backend="native"
            )
            results.append((parts, frames))
    for parts, frames in results[1:]:
        assert torch.equal(parts, results[0][0])
        assert torch.equal(frames, results[0][1])


def test_a_clip_has_the_same_tiles_in_any_company():
    alone, together = ops.WinogradTiles.of((13,), 3), ops.WinogradTiles.of((20, 13, 5), 3)
    first = len(ops.WinogradTiles.of((20,), 3))
    for ours, theirs in ((alone.taken, together.taken), (alone.made, together.made)):
        assert torch.equal(torch.where(ours >= 0, ours + 20, -1), theirs[first : first + len(alone)])


def test_what_is_no_number_shows_where_it_is_met_and_nowhere_else(isa):
    case = Case((40, 40), 1, 20, 20)
    x = case.x
    x[45, 3] = torch.nan
    products = ops.winograd_parts(x, case.tiles) @ ops.winograd_weights(case.weight).mT
    y = ops.winograd_frames(products, case.tiles, case.bias, is_rectified=True)
    assert y[44:47].isnan().all()
    assert not y[:40].isnan().any()


def test_any_strides(isa):
    case = Case((30,), 1, 20, 24)
    x, products = case.x.T.contiguous().T, case.products.transpose(0, 2).contiguous().transpose(0, 2)
    assert torch.equal(ops.winograd_parts(x, case.tiles), ops.winograd_parts(case.x, case.tiles))
    bias = case.bias[:, None].expand(-1, 2)[:, 0]
    assert torch.equal(
        ops.winograd_frames(products, case.tiles, bias),
        ops.winograd_frames(case.products, case.tiles, case.bias),
    )


TILES = ops.WinogradTiles.of((6,), 1)
GOOD = {"taken": TILES.taken, "made": TILES.made, "frames": 6}
TWICE = TILES.made.clone()
TWICE[0, 1] = 0
BEYOND = TILES.taken.clone()
BEYOND[0, 0] = 6


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"taken": TILES.taken[:, :5]}, r"`taken` must be int64 of shape \(2, 6\), got .* of \(2, 5\)"),
        ({"made": TILES.made.int()}, r"`made` must be int64 of shape \(2, 4\), got torch\.int32"),
        ({"made": TILES.made[:1]}, r"`made` must be int64 of shape \(2, 4\), got .*\(1, 4\)"),
        ({"taken": BEYOND}, r"`taken` must lie within \[-1, 6\), got -1 to 6"),
        ({"made": TWICE}, "`made` must name every frame once, got 2 times 0"),
        ({"frames": 7}, "`made` must name every frame once, got 0 times 6"),
    ],
)  # fmt: skip
def test_tiles_that_do_not_fit_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        ops.WinogradTiles(**{**GOOD, **change})


@pytest.mark.parametrize(("lengths", "distance"), [((3,), 0), ((-1,), 1)])
def test_lengths_that_do_not_fit_are_refused(lengths, distance):
    with pytest.raises(ValueError, match="`distance` must be positive and `lengths` not negative"):
        ops.WinogradTiles.of(lengths, distance)


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_tensors_that_do_not_fit_are_refused(backend):
    x, products, bias = torch.zeros(6, 3), torch.zeros(6, 2, 5), torch.zeros(5)
    for wrong in (x[:5], x[None], x.long()):
        with pytest.raises(ValueError, match=r"`x` must be floating-point of shape \(6, C\)"):
            ops.winograd_parts(wrong, TILES, backend=backend)
    for wrong in (products[:5], products[:, :1], products[0], products.long()):
        with pytest.raises(ValueError, match=r"`products` must be floating-point of shape \(6, 2, D\)"):
            ops.winograd_frames(wrong, TILES, backend=backend)
    for wrong in (bias[:4], bias.double(), bias[None]):
        with pytest.raises(ValueError, match=r"`bias` must be torch\.float32 of shape \(5,\)"):
            ops.winograd_frames(products, TILES, wrong, backend=backend)
    for wrong in (torch.zeros(5, 3, 2), torch.zeros(5, 3), torch.zeros(5, 3, 3).long()):
        with pytest.raises(ValueError, match=r"`weight` must be floating-point of shape \(D, C, 3\), got"):
            ops.winograd_weights(wrong)
