"""Metrics against values of the public functions (shared/reference/golden/metrics_synthetic.npz)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch

from controlmm.evaluation import (
    control_errors,
    frechet_distance,
    matching_distance,
    published_skating_ratio,
    r_precision,
)
from controlmm.evaluation.variety import pair_distance
from controlmm.motion.skeleton import KIT

ROUNDING = 1e-12  # relative, of float64 sums in another order
FID_ROUNDING = 1e-9  # relative: the public value is of a general matrix root, ours of eigenvalues
# The golden errors come from float32 positions; ours are differences in float64 of the same numbers.
SINGLE_PRECISION = 1e-6


@pytest.fixture(scope="module")
def golden(shared: Path) -> Mapping[str, torch.Tensor]:
    arrays = np.load(shared / "reference" / "golden" / "metrics_synthetic.npz")
    return {name: torch.from_numpy(arrays[name]) for name in arrays}


def test_r_precision_and_matching_distance(golden: Mapping[str, torch.Tensor]) -> None:
    torch.testing.assert_close(r_precision(golden["text"], golden["gen"]), golden["r_precision"])
    distance = matching_distance(golden["text"], golden["gen"])
    assert distance == pytest.approx(golden["mm_dist"].item(), rel=ROUNDING)


def test_frechet_distance(golden: Mapping[str, torch.Tensor]) -> None:
    expected = golden["fid_gt_gen"].item()
    assert frechet_distance(golden["gt"], golden["gen"]) == pytest.approx(expected, rel=FID_ROUNDING)
    assert frechet_distance(golden["gen"], golden["gt"]) == pytest.approx(expected, rel=FID_ROUNDING)


def test_diversity_of_given_pairs(golden: Mapping[str, torch.Tensor]) -> None:
    found = pair_distance(golden["gen"], golden["div_first"], golden["div_second"])
    assert found == pytest.approx(golden["diversity300"].item(), rel=ROUNDING)


def test_multimodality_of_given_pairs(golden: Mapping[str, torch.Tensor]) -> None:
    found = pair_distance(golden["mm"].transpose(0, 1), golden["mm_first"], golden["mm_second"])
    assert found == pytest.approx(golden["multimodality10"].item(), rel=ROUNDING)


@pytest.mark.parametrize("rule", ["joint", "frame"])
def test_control_errors_by_both_rules(golden: Mapping[str, torch.Tensor], rule: str) -> None:
    errors = control_errors(golden["ctrl_pred"], golden["ctrl_gt"], golden["ctrl_mask"], rule=rule)
    found = torch.stack(
        [*errors.trajectory.values(), *errors.location.values(), errors.average], dim=1
    )  # 20 and 50 cm each
    torch.testing.assert_close(found, golden[f"ctrl_per_{rule}"], rtol=0, atol=SINGLE_PRECISION)


def test_the_two_rules_differ_on_this_data(golden: Mapping[str, torch.Tensor]) -> None:
    assert not torch.equal(golden["ctrl_per_joint"], golden["ctrl_per_frame"])


def test_published_skating_ratio(golden: Mapping[str, torch.Tensor]) -> None:
    ratio = published_skating_ratio(golden["ctrl_pred"])
    torch.testing.assert_close(ratio.double(), golden["skating"], rtol=0, atol=SINGLE_PRECISION)


def test_published_skating_ratio_of_kit(golden: Mapping[str, torch.Tensor]) -> None:
    millimetres = 1000 * golden["ctrl_pred"][:, :, : KIT.num_joints]  # joints 15 and 20 are KIT's toes
    ratio = published_skating_ratio(millimetres, skeleton=KIT)
    torch.testing.assert_close(ratio.double(), golden["skating_kit"], rtol=0, atol=SINGLE_PRECISION)
