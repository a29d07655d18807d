"""Feature statistics: the published numbers, the bias, and the file."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from controlmm.motion.layout import feature_layout
from controlmm.motion.normalizer import ROOT_CONTACT_BIAS, Normalizer, biased_std, channel_statistics
from controlmm.motion.skeleton import HUMANML3D

GROUPS = feature_layout(HUMANML3D).groups
HEAVY = (0, 1, 2, 6)  # root yaw, root velocity, root height, contacts


def random_clips(count: int = 3):
    generator = torch.Generator().manual_seed(0)
    return [
        torch.randn(20 + 7 * i, 263, generator=generator) * (1 + torch.arange(263) % 5) for i in range(count)
    ]


def test_statistics_are_those_of_all_frames_with_one_deviation_a_group():
    clips = random_clips()
    frames = torch.cat(clips).double()
    mean, std = channel_statistics(clips)
    torch.testing.assert_close(mean, frames.mean(0))
    for group in GROUPS:
        expected = frames[:, group].std(0, correction=0).mean()
        torch.testing.assert_close(std[group], expected.expand(group.stop - group.start))


def test_the_bias_divides_the_root_and_contact_groups_once():
    clips = random_clips()
    plain, biased = Normalizer.fit(clips, root_contact_bias=1.0).std, Normalizer.fit(clips).std
    for index, group in enumerate(GROUPS):
        factor = ROOT_CONTACT_BIAS if index in HEAVY else 1.0
        torch.testing.assert_close(biased[group], plain[group] / factor)


def test_the_published_deviations_differ_by_the_bias(shared):
    """The evaluator's Std is HumanML3D's with the bias applied, up to its older data build."""
    folder = shared / "data" / "humanml3d"
    plain = torch.from_numpy(np.load(folder / "Std.npy")).double()
    evaluator = torch.from_numpy(np.load(folder / "t2m_std.npy"))
    older_build = 0.012
    torch.testing.assert_close(biased_std(plain, ROOT_CONTACT_BIAS), evaluator, rtol=older_build, atol=0)


def test_biased_deviations_leave_their_input_alone():
    std = torch.ones(263)
    biased_std(std, 25.0)
    assert torch.equal(std, torch.ones(263))


def test_normalised_features_have_zero_mean_and_come_back():
    clips = random_clips()
    normalizer = Normalizer.fit(clips)
    normalized = normalizer.normalize(torch.cat(clips))
    assert normalized.mean(0).abs().max() < 1e-4
    torch.testing.assert_close(normalizer.denormalize(normalized), torch.cat(clips), rtol=1e-5, atol=1e-5)


def test_statistics_survive_the_file(tmp_path):
    normalizer = Normalizer.fit(random_clips())
    normalizer.save(tmp_path / "n.safetensors")
    loaded = Normalizer.load(tmp_path / "n.safetensors")
    assert torch.equal(loaded.mean, normalizer.mean)
    assert torch.equal(loaded.std, normalizer.std)
    assert loaded.skeleton is HUMANML3D


def test_missing_and_damaged_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="No feature statistics at"):
        Normalizer.load(tmp_path / "none.safetensors")
    file = tmp_path / "n.safetensors"
    Normalizer.fit(random_clips()).save(file)
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(ValueError, match=r"n\.safetensors holds no readable feature statistics"):
        Normalizer.load(file)


def test_a_channel_that_never_changes_is_named():
    std = torch.ones(263)
    std[259:] = 0
    with pytest.raises(ValueError, match="channel 259 has mean 0 and std 0"):
        Normalizer(torch.zeros(263), std)


@pytest.mark.parametrize("width", [0, 100, 264])
def test_other_widths_are_refused(width):
    with pytest.raises(ValueError, match="263 wide"):
        Normalizer(torch.zeros(width), torch.ones(width))


def test_shapes_must_agree():
    with pytest.raises(ValueError, match="`mean` and `std` must both be"):
        Normalizer(torch.zeros(263), torch.ones(251))


def test_no_clips_and_a_bad_bias_are_refused():
    with pytest.raises(ValueError, match="need at least one clip"):
        Normalizer.fit([])
    with pytest.raises(ValueError, match="`root_contact_bias` must be positive, got 0"):
        Normalizer.fit(random_clips(), root_contact_bias=0.0)
