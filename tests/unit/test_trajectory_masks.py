"""Which coordinates TLControl's training gives: published strategies, their curricula, and ours."""

from __future__ import annotations

import pytest
import torch

from controlmm.models.rvq_vae import frame_mask
from controlmm.training.trajectory_masks import given_coordinates

LENGTHS = torch.tensor([120, 80, 196, 40])
FRAMES = frame_mask(LENGTHS, 196)


def draws(masking: str, *, progress: float, count: int = 300) -> list[torch.Tensor]:
    torch.manual_seed(3)
    return [given_coordinates(masking, FRAMES, joints=6, progress=progress) for _ in range(count)]


@pytest.mark.parametrize("masking", ["mixed", "paper", "released"])
def test_nothing_is_given_behind_the_end_of_a_clip(masking):
    for given in draws(masking, progress=0.5, count=40):
        assert given.shape == (4, 196, 6, 3)
        assert not given[~FRAMES].any()


def test_the_released_code_keeps_one_joint_seven_times_in_ten():
    kept = [given[2].all(0).all(-1).sum().item() for given in draws("released", progress=0.05)]
    share = [sum(count == wanted for count in kept) / len(kept) for wanted in (1, 6)]
    assert share[0] == pytest.approx(0.7, abs=0.11)  # 4 standard deviations of 300 draws
    assert share[1] == pytest.approx(0.1, abs=0.07)


def test_all_clips_of_a_released_batch_have_the_same_mask():
    for given in draws("released", progress=0.5, count=30):
        assert torch.equal(given[0, :40], given[3, :40])


@pytest.mark.parametrize(("progress", "share"), [(0.05, 0.2), (0.11, 0.4), (0.5, 0.5)])
def test_released_segments_follow_the_curriculum(progress, share):
    segments = [given[2] for given in draws("released", progress=progress) if not given[2].all(0).any()]
    assert segments
    for given in segments:
        hidden = 1 - given[..., 0].float().mean(0)
        torch.testing.assert_close(hidden, torch.full((6,), round(share * 196) / 196), rtol=0, atol=1e-6)


@pytest.mark.parametrize("progress", [0.0, 0.4, 1.0])
def test_the_papers_segments_grow_to_three_quarters(progress):
    hidden = []
    for given in draws("paper", progress=progress, count=60):
        by_joint = 1 - given[2, ..., 0].float().mean(0)
        if not torch.isin(by_joint, torch.tensor([0.0, 1.0])).all():
            hidden.append(by_joint)
    assert bool(hidden) == (progress > 0)
    for by_joint in hidden:
        expected = round(0.75 * progress * 196) / 196
        torch.testing.assert_close(by_joint, torch.full((6,), expected), rtol=0, atol=1e-6)


def test_the_paper_hides_any_number_of_joints():
    counts = {int(given[2].all(0).all(-1).sum()) for given in draws("paper", progress=0.5)}
    assert counts == set(range(7))


def test_our_clips_are_masked_one_by_one_in_all_kinds():
    kinds = set()
    differs = 0
    for given in draws("mixed", progress=0.0):
        clip = given[2]
        whole = clip.all(0).all(-1)
        if whole.all():
            kinds.add("all")
        elif not clip.any():
            kinds.add("none")
        elif (clip.flatten(1).any(1).all()) and torch.equal(clip.any(0).all(-1), whole):
            kinds.add("subset")
        elif clip[:, 0, 0].any() and not clip[..., 1].any():
            kinds.add("path")
        else:
            kinds.add("frames")
        differs += not torch.equal(given[0, :40], given[3, :40])
    assert kinds == {"all", "none", "subset", "path", "frames"}
    assert differs > 200


def test_an_unknown_strategy_is_named():
    with pytest.raises(ValueError, match=r"Unknown masking 'half'\. Use one of: mixed, paper, released"):
        given_coordinates("half", FRAMES, joints=6, progress=0.0)
