"""Penetration, jerk, bone lengths, contacts and tokenizer metrics on cases worked by hand."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from controlmm.evaluation import (
    bone_length_deviation,
    code_perplexity,
    code_usage,
    contact_consistency,
    floor_penetration,
    foot_skating_ratio,
    global_error,
    mean_jerk,
    published_skating_ratio,
    root_aligned_error,
)
from controlmm.evaluation.reconstruction import code_statistics
from controlmm.motion.features import joints_to_features
from controlmm.pipelines import ControlMM

ROUNDING = 1e-5  # of float32 sums over a clip
PAD = 30


def _padded(joints: torch.Tensor, frames: int) -> torch.Tensor:
    """A clip followed by frames that must not matter."""
    return torch.cat([joints, torch.full((len(joints), frames, 22, 3), -7.0)], dim=1)


def test_depth_of_the_lowest_joint_below_the_floor() -> None:
    joints = torch.ones(1, 4, 22, 3)
    joints[0, 1, 10, 1], joints[0, 1, 11, 1] = -0.02, -0.06
    joints[0, 3, 7, 1] = -0.02
    assert floor_penetration(joints).item() == pytest.approx(0.08 / 4)
    assert floor_penetration(_padded(joints, PAD), lengths=torch.tensor([4])).item() == pytest.approx(0.02)


def test_jerk_of_a_cubic_path() -> None:
    # x = t^3 / 6 has jerk 1 m/s^3 everywhere, and third differences of cubics are exact
    seconds = torch.arange(30, dtype=torch.float64) / 20
    joints = torch.zeros(1, 30, 22, 3, dtype=torch.float64)
    joints[0, :, :, 0] = (seconds**3 / 6)[:, None]
    assert mean_jerk(joints).item() == pytest.approx(1.0)
    assert mean_jerk(_padded(joints, PAD), lengths=torch.tensor([30])).item() == pytest.approx(1.0)
    assert mean_jerk(joints[:, :3]).item() == 0


def test_bones_of_a_rigid_body_do_not_deviate(walk: Callable[..., torch.Tensor]) -> None:
    joints = walk(40)[None].float()
    assert bone_length_deviation(joints).item() == pytest.approx(0.0, abs=ROUNDING)
    assert bone_length_deviation(_padded(joints, PAD), lengths=torch.tensor([40])).item() == pytest.approx(
        0.0, abs=ROUNDING
    )


def test_one_bone_that_changes_counts_as_one_of_all() -> None:
    joints = torch.zeros(1, 2, 22, 3)
    joints[0, :, 20, 0] = torch.tensor([0.2, 0.4])  # the last bone of the left arm: deviation 0.1
    assert bone_length_deviation(joints).item() == pytest.approx(0.1 / 21)


def test_contacts_agree_with_the_motion_they_were_made_from(walking_joints: torch.Tensor) -> None:
    features = joints_to_features(walking_joints)[None]
    joints = walking_joints[None, : features.shape[1]]
    assert contact_consistency(features, joints).item() == 1
    flipped = features.clone()
    flipped[..., -1] = 1 - flipped[..., -1]
    assert contact_consistency(flipped, joints).item() == pytest.approx(0.75)


def test_errors_with_and_without_the_root() -> None:
    targets = torch.zeros(1, 5, 22, 3)
    moved = targets + torch.tensor([0.3, 0.0, 0.4])
    lengths = torch.tensor([5])
    assert root_aligned_error(moved, targets, lengths=lengths).item() == pytest.approx(0.0, abs=ROUNDING)
    assert global_error(moved, targets, lengths=lengths).item() == pytest.approx(0.5)
    moved[0, :, 21, 0] += 0.22
    assert root_aligned_error(moved, targets, lengths=lengths).item() == pytest.approx(0.22 / 22)


def test_padding_does_not_count_in_reconstruction_errors() -> None:
    targets = torch.zeros(1, 10, 22, 3)
    joints = targets.clone()
    joints[0, 5:] = 9.0
    assert global_error(joints, targets, lengths=torch.tensor([5])).item() == 0


def test_perplexity_of_each_layer() -> None:
    ids = torch.tensor([[[0, 3], [1, 3], [2, -1], [3, -1]], [[-1, -1]] * 4])
    torch.testing.assert_close(code_perplexity(ids, codebook_size=8).float(), torch.tensor([4.0, 1.0]))
    torch.testing.assert_close(code_usage(ids, codebook_size=8).float(), torch.tensor([0.5, 0.125]))


def test_published_skating_counts_padding_and_ours_does_not() -> None:
    joints = torch.zeros(1, 196, 22, 3)
    joints[0, :, :, 0] = (torch.arange(196) * 0.1)[:, None]  # slides at 2 m/s on the floor
    joints[0, 40:] = joints[0, 39]  # padding that stands still
    # the 5-frame average falls below 0.5 m/s two pairs beyond the last slide only
    assert foot_skating_ratio(joints, lengths=torch.tensor([40])).item() == 1
    assert published_skating_ratio(joints).item() == pytest.approx(39 / 195)


def test_lengths_are_checked() -> None:
    with pytest.raises(ValueError, match="`lengths` must hold one number from 1 to 4"):
        floor_penetration(torch.zeros(1, 4, 22, 3), lengths=torch.tensor([5]))
    with pytest.raises(ValueError, match=r"`joints` must be \(B, T, J, 3\)"):
        mean_jerk(torch.zeros(4, 22, 3))


def test_codes_of_all_clips_are_counted_together(
    tiny_pipeline: ControlMM, walking_joints: torch.Tensor
) -> None:
    clip = joints_to_features(walking_joints).float()
    once, twice = (code_statistics(tiny_pipeline.decoder, [clip] * times) for times in (1, 2))
    assert torch.equal(once.perplexity, twice.perplexity)
    assert once.perplexity.shape == once.usage.shape == (3,)
    assert (once.perplexity >= 1).all()
    assert (once.perplexity <= 32 * once.usage + ROUNDING).all()  # at most the number of codes in use
