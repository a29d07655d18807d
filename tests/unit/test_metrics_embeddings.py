"""Retrieval, Frechet distance and variety on cases worked by hand."""

from __future__ import annotations

import pytest
import torch

from controlmm.evaluation import (
    diversity,
    frechet_distance,
    interval,
    matching_distance,
    multimodality,
    r_precision,
)

EIGENVALUES = 1e-9  # of a float64 eigen-decomposition of small matrices
SAMPLING = 0.05  # of covariances of 4,000 seeded samples, relative


def _on_a_line(*places: float) -> torch.Tensor:
    return torch.tensor(places, dtype=torch.float64)[:, None]


def test_r_precision_counts_the_texts_whose_motion_is_near() -> None:
    texts = _on_a_line(0.0, 10.0, 20.0, 30.0)
    # distances of text 0: 1 (own), 9, 19, 29. Text 1: own 9; motion 1 away at 11, motion 2 at 9 away ...
    motions = _on_a_line(1.0, 1.5, 21.0, 12.0)
    # text 1 (10): 9, 8.5 own, 11, 2 -> second. Text 3 (30): 29, 28.5, 9, 18 own -> second.
    assert r_precision(texts, motions, group=4).tolist() == [0.5, 1.0, 1.0]


def test_r_precision_stays_inside_its_groups_and_leaves_out_the_rest() -> None:
    texts = _on_a_line(0.0, 5.0, 0.0, 5.0, 0.0)
    motions = _on_a_line(0.1, 5.1, 0.1, 5.1, 999.0)
    assert r_precision(texts, motions, group=2, top=1).tolist() == [1.0]


def test_a_pool_of_another_size_gives_another_number() -> None:
    generator = torch.Generator().manual_seed(0)
    texts = torch.randn(64, 4, generator=generator)
    motions = texts + torch.randn(64, 4, generator=generator)
    assert r_precision(texts, motions, group=8)[0] > r_precision(texts, motions, group=32)[0]


def test_near_pairs_far_from_the_origin_are_still_told_apart() -> None:
    texts = _on_a_line(0.0, 1e-4, 2e-4, 3e-4) + 1e3
    assert r_precision(texts.float(), texts.float(), group=4, top=1).tolist() == [1.0]


def test_r_precision_refuses_an_incomplete_group() -> None:
    with pytest.raises(ValueError, match="needs a complete group of 32 pairs, got 31 pairs"):
        r_precision(torch.zeros(31, 4), torch.zeros(31, 4))


def test_pairs_must_match() -> None:
    with pytest.raises(ValueError, match=r"`texts` and `motions` must both be \(N, E\)"):
        matching_distance(torch.zeros(3, 4), torch.zeros(2, 4))


def test_matching_distance_is_the_mean_distance_of_pairs() -> None:
    texts = torch.tensor([[0.0, 0.0], [1.0, 1.0]])
    motions = torch.tensor([[3.0, 4.0], [1.0, 2.0]])
    assert matching_distance(texts, motions) == pytest.approx((5 + 1) / 2)


def test_frechet_distance_of_clouds_with_known_moments() -> None:
    # corners of boxes: variances 4/3 and 16/3 (unbiased, 4 points at +-1 and +-2); centres 3 apart
    small = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [1.0, 0.0], [-1.0, 0.0]], dtype=torch.float64)
    large = 2 * small + torch.tensor([0.0, 3.0], dtype=torch.float64)
    expected = 9 + (4 / 3) + (16 / 3) - 2 * (4 / 3 * 16 / 3) ** 0.5
    assert frechet_distance(small, large) == pytest.approx(expected, abs=EIGENVALUES)


def test_frechet_distance_to_itself_is_zero_also_with_few_samples() -> None:
    few = torch.randn(10, 32, generator=torch.Generator().manual_seed(1))  # singular covariance
    assert frechet_distance(few, few) == pytest.approx(0.0, abs=EIGENVALUES)


def test_frechet_distance_agrees_with_a_general_matrix_root() -> None:
    generator = torch.Generator().manual_seed(2)
    a = torch.randn(200, 6, generator=generator, dtype=torch.float64)
    b = torch.randn(300, 6, generator=generator, dtype=torch.float64) @ torch.randn(
        6, 6, generator=generator, dtype=torch.float64
    )
    product = torch.cov(a.T) @ torch.cov(b.T)
    root_trace = torch.linalg.eigvals(product).sqrt().real.sum()  # no symmetry used
    means = (a.mean(0) - b.mean(0)).square().sum()
    expected = means + torch.cov(a.T).trace() + torch.cov(b.T).trace() - 2 * root_trace
    assert frechet_distance(a, b) == pytest.approx(expected.item(), rel=EIGENVALUES)


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        (torch.zeros(1, 3), torch.zeros(5, 3), r"`a` must be \(N, E\) with N >= 2"),
        (torch.zeros(5, 3), torch.zeros(5, 2), "`a` and `b` must have one width, got 3 and 2"),
        (torch.zeros(5, 3), torch.full((5, 3), torch.nan), "`b` holds embeddings that are not finite"),
    ],
)
def test_unusable_clouds_are_refused(a: torch.Tensor, b: torch.Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        frechet_distance(a, b)


def test_diversity_of_two_places() -> None:
    # Half of the motions at 0, half at 1: a random pair differs with probability one half.
    motions = _on_a_line(*([0.0] * 2000 + [1.0] * 2000))
    found = [diversity(motions, generator=torch.Generator().manual_seed(seed)) for seed in range(40)]
    assert sum(found) / 40 == pytest.approx(0.5, rel=SAMPLING)


def test_diversity_of_few_motions_takes_fewer_pairs_and_depends_on_the_seed_only() -> None:
    motions = torch.randn(20, 3, generator=torch.Generator().manual_seed(3))
    first, again, other = (
        diversity(motions, generator=torch.Generator().manual_seed(seed)) for seed in (0, 0, 1)
    )
    assert first == again != other


def test_multimodality_ignores_differences_between_texts() -> None:
    motions = _on_a_line(0.0, 100.0, 200.0)[:, None].expand(3, 12, 1)  # every text always the same motion
    assert multimodality(motions, generator=torch.Generator().manual_seed(0)) == 0


def test_multimodality_needs_enough_motions_of_a_text() -> None:
    with pytest.raises(ValueError, match=r"S >= 10 \(`pairs`\), got \(3, 4, 8\)"):
        multimodality(torch.zeros(3, 4, 8), generator=torch.Generator())


def test_interval_of_repeats() -> None:
    # population deviation of 1, 2, 3 is sqrt(2/3)
    found = interval([1.0, 2.0, 3.0])
    assert found.mean == 2
    assert found.half_width == pytest.approx(1.96 * (2 / 3) ** 0.5 / 3**0.5)
    assert found.shown(2) == "2.00 ± 0.92"


def test_one_repeat_has_no_spread_and_repeats_without_a_value_do_not_count() -> None:
    assert interval([0.25]).shown() == "0.250"
    assert interval([float("nan"), 4.0]).mean == 4
    assert str(interval([float("nan")])) == "nan"
    with pytest.raises(ValueError, match="got none"):
        interval([])
