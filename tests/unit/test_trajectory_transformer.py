"""The trajectory transformer: published size and form, padding, what the masked form sees beyond it."""

from __future__ import annotations

import pytest
import torch

from controlmm.models.rvq_vae import frame_mask
from controlmm.models.trajectory_transformer import TrajectoryTransformer, TrajectoryTransformerConfig
from controlmm.motion.skeleton import KIT

SAME_CLIP = 1e-5  # float32 sums over another batch size and length


@pytest.fixture
def masked() -> TrajectoryTransformer:
    torch.manual_seed(0)
    return TrajectoryTransformer(TrajectoryTransformerConfig.tiny()).eval()


@pytest.fixture
def published() -> TrajectoryTransformer:
    torch.manual_seed(0)
    config = TrajectoryTransformerConfig.tiny()
    return TrajectoryTransformer(type(config)(**{**vars(config), "form": "published"})).eval()


def inputs(lengths: tuple[int, ...] = (7, 4)) -> tuple[torch.Tensor, ...]:
    """Trajectories, what is given of them, text, validity."""
    generator = torch.Generator().manual_seed(2)
    valid = frame_mask(torch.tensor(lengths), max(lengths))
    frames = valid.repeat_interleave(4, dim=1)
    given = (torch.rand(len(lengths), frames.shape[1], 6, 3, generator=generator) < 0.6) & frames[
        :, :, None, None
    ]
    trajectories = torch.randn(*given.shape, generator=generator) * given
    return trajectories, given, torch.randn(len(lengths), 64, generator=generator), valid


def test_the_paper_configuration_has_the_published_size():
    with torch.device("meta"):
        model = TrajectoryTransformer(TrajectoryTransformerConfig.paper())
    assert round(sum(p.numel() for p in model.parameters()) / 1e6, 2) == 15.41


def test_logits_have_one_row_a_token_and_part(masked):
    assert masked(*inputs()).shape == (2, 7, 6, 16)


def test_padding_does_not_change_the_logits_of_a_clip(masked):
    trajectories, given, text, valid = inputs()
    padded = masked(trajectories, given, text, valid)
    alone = masked(trajectories[1:, :16], given[1:, :16], text[1:], valid[1:, :4])
    torch.testing.assert_close(padded[1:, :4], alone, rtol=0, atol=SAME_CLIP)


def test_an_unknown_coordinate_differs_from_the_mean_position_in_the_masked_form_only(masked, published):
    trajectories, given, text, valid = inputs()
    zero = torch.zeros_like(trajectories)
    none = torch.zeros_like(given)
    assert (masked(zero, given, text, valid) - masked(zero, none, text, valid)).abs().max() > 1e-4
    assert torch.equal(published(zero, given, text, valid), published(zero, none, text, valid))


def test_text_changes_the_logits(masked):
    trajectories, given, text, valid = inputs()
    other = masked(trajectories, given, torch.zeros_like(text), valid)
    assert (masked(trajectories, given, text, valid) - other).abs().max() > 1e-5


def test_every_part_has_its_own_output_in_the_masked_form(masked, published):
    assert (len(masked.to_codes), len(published.to_codes)) == (6, 1)
    before = masked(*inputs())
    with torch.no_grad():
        masked.to_codes[2].bias += 1.0
    difference = (masked(*inputs()) - before).abs().amax((0, 1, 3))
    assert difference[2] > 0.5
    assert difference[[0, 1, 3, 4, 5]].max() == 0


def test_trajectories_are_normalised_and_zero_where_not_given(masked):
    masked.trajectory_mean.copy_(torch.tensor([1.0, 2.0, 3.0]))
    masked.trajectory_std.copy_(torch.tensor([2.0, 4.0, 5.0]))
    targets = torch.full((1, 4, 22, 3), 7.0)
    mask = torch.zeros(1, 4, 22, 3, dtype=torch.bool)
    mask[0, 1, 20] = True  # the left wrist is the third trajectory
    mask[0, 2, 5] = True  # no trajectory of the six
    values, given = masked.trajectories(targets, mask)
    assert torch.equal(values[0, 1, 2], torch.tensor([3.0, 1.25, 0.8]))
    assert given.sum() == 3
    assert values.count_nonzero() == 3


def test_bundles_are_frame_major_and_carry_steps_between_given_frames(masked):
    trajectories = torch.zeros(1, 8, 6, 3)
    trajectories[0, :, 1] = torch.arange(24.0).view(8, 3)
    given = torch.zeros(1, 8, 6, 3, dtype=torch.bool)
    given[0, [0, 1, 3, 4], 1] = True
    bundles = masked._bundles(trajectories * given, given)
    positions, steps, flags = bundles[0, 0, 1].chunk(3)
    assert torch.equal(positions, torch.tensor([0.0, 1, 2, 3, 4, 5, 0, 0, 0, 9, 10, 11]))
    assert torch.equal(steps, torch.tensor([0.0] * 3 + [60.0] * 3 + [0.0] * 6))
    assert torch.equal(flags, torch.tensor([1.0] * 6 + [0.0] * 3 + [1.0] * 3))
    assert torch.equal(bundles[0, 1, 1, 12:15], torch.tensor([60.0] * 3))  # over the edge of a bundle
    assert bundles[0, :, [0, 2, 3, 4, 5]].abs().max() == 0


def test_the_published_form_attends_to_padding(published):
    trajectories, given, text, valid = inputs()
    moved = trajectories.clone()
    moved[1, 20:] = 1.0
    difference = published(moved, given, text, valid) - published(trajectories, given, text, valid)
    assert difference[1, :4].abs().max() > 0


def test_joints_follow_the_skeleton():
    assert TrajectoryTransformerConfig.small().for_skeleton(KIT).joints == (0, 4, 10, 7, 20, 15)


def test_too_many_tokens_and_impossible_configurations_are_refused(masked):
    with pytest.raises(ValueError, match="At most 49 tokens are possible, got 50"):
        masked(*inputs((50,)))
    with pytest.raises(ValueError, match="`width` and `head_width` must be multiples of `heads`"):
        TrajectoryTransformerConfig(heads=5)
    with pytest.raises(ValueError, match="`form` must be 'masked' or 'published', got 'old'"):
        TrajectoryTransformerConfig(form="old")
