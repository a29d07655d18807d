"""Control errors on cases worked by hand, and the mistakes that others made with them."""

from __future__ import annotations

import math

import pytest
import torch

from controlmm.evaluation import control_errors

PELVIS, LEFT_WRIST, RIGHT_WRIST = 0, 20, 21
ROUNDING = 1e-7  # of float32 inputs such as 0.3


def _clip(frames: int = 4) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    targets = torch.full((1, frames, 22, 3), torch.nan)  # nothing outside the mask may be looked at
    return torch.zeros(1, frames, 22, 3), targets, torch.zeros(1, frames, 22, dtype=torch.bool)


def _aim(targets: torch.Tensor, mask: torch.Tensor, frame: int, joint: int, distance: float) -> None:
    targets[0, frame, joint] = torch.tensor([0.0, 0.6 * distance, 0.8 * distance])
    mask[0, frame, joint] = True


def test_one_joint_in_four_frames() -> None:
    joints, targets, mask = _clip()
    for frame, distance in enumerate((0.0, 0.1, 0.3, 0.6)):
        _aim(targets, mask, frame, PELVIS, distance)
    for rule in ("joint", "frame"):
        errors = control_errors(joints, targets, mask, rule=rule)
        assert errors.average.item() == pytest.approx(0.25, abs=ROUNDING)
        assert errors.trajectory[0.2].item() == errors.trajectory[0.5].item() == 1
        assert (errors.location[0.2].item(), errors.location[0.5].item()) == (0.5, 0.25)


def test_the_mean_is_over_keys_not_over_coordinates() -> None:
    """A public scorer divides by the mask summed over x, y and z and so reports a third of this."""
    joints, targets, mask = _clip()
    _aim(targets, mask, 1, LEFT_WRIST, 0.3)
    assert control_errors(joints, targets, mask).average.item() == pytest.approx(0.3, abs=ROUNDING)


def test_a_far_joint_is_not_excused_by_a_near_one() -> None:
    """Averaging over the joints of a frame before the threshold hides a miss of 60 cm."""
    joints, targets, mask = _clip()
    _aim(targets, mask, 0, LEFT_WRIST, 0.6)
    _aim(targets, mask, 0, RIGHT_WRIST, 0.0)
    strict, lenient = (control_errors(joints, targets, mask, rule=rule) for rule in ("joint", "frame"))
    assert (strict.trajectory[0.5].item(), lenient.trajectory[0.5].item()) == (1, 0)
    assert (strict.location[0.5].item(), lenient.location[0.5].item()) == (0.5, 0)
    assert strict.average.item() == pytest.approx(lenient.average.item())


def test_frames_with_many_joints_weigh_more_by_the_joint_rule_only() -> None:
    joints, targets, mask = _clip()
    _aim(targets, mask, 0, LEFT_WRIST, 0.2)
    _aim(targets, mask, 0, RIGHT_WRIST, 0.4)
    _aim(targets, mask, 1, PELVIS, 0.6)
    assert control_errors(joints, targets, mask).average.item() == pytest.approx(0.4, abs=ROUNDING)
    by_frame = control_errors(joints, targets, mask, rule="frame")
    assert by_frame.average.item() == pytest.approx(0.45, abs=ROUNDING)


def test_padding_and_free_joints_do_not_count() -> None:
    """Dividing by all frames of the padded tensor would make sparse controls look easy."""
    joints, targets, mask = _clip(frames=196)
    _aim(targets, mask, 0, PELVIS, 0.6)
    errors = control_errors(joints, targets, mask)
    assert errors.average.item() == pytest.approx(0.6, abs=ROUNDING)
    assert errors.location[0.5].item() == 1


def test_clips_weigh_alike_however_many_keys_they_have() -> None:
    joints, targets, mask = (torch.cat(pair) for pair in zip(_clip(), _clip(), strict=True))
    for frame in range(4):
        targets[0, frame, 0], mask[0, frame, 0] = torch.tensor([0.1, 0.0, 0.0]), True
    targets[1, 0, 0], mask[1, 0, 0] = torch.tensor([0.5, 0.0, 0.0]), True
    torch.testing.assert_close(
        control_errors(joints, targets, mask).average.float(), torch.tensor([0.1, 0.5])
    )


def test_an_error_of_exactly_the_threshold_passes() -> None:
    joints, targets, mask = _clip()
    targets[0, 0, 0], mask[0, 0, 0] = torch.tensor([0.5, 0.0, 0.0]), True
    assert control_errors(joints, targets, mask).trajectory[0.5].item() == 0


def test_a_target_at_the_origin_counts() -> None:
    """One scorer takes a target for absent when its coordinates sum to zero."""
    joints, targets, mask = _clip()
    joints[0, 0, 0, 0] = 0.3
    targets[0, 0, 0], mask[0, 0, 0] = 0.0, True
    assert control_errors(joints, targets, mask).average.item() == pytest.approx(0.3, abs=ROUNDING)


def test_a_clip_without_targets_has_no_error() -> None:
    joints, targets, mask = _clip()
    errors = control_errors(joints, targets, mask)
    assert all(math.isnan(x.item()) for x in (errors.average, errors.trajectory[0.5], errors.location[0.5]))


def test_shapes_and_rule_are_checked() -> None:
    joints, targets, mask = _clip()
    with pytest.raises(ValueError, match=r"`mask` \(B, T, J\)"):
        control_errors(joints, targets, mask[..., None].expand(-1, -1, -1, 3))
    with pytest.raises(ValueError, match="`rule` must be one of"):
        control_errors(joints, targets, mask, rule="axis")
