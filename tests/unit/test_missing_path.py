"""What the control networks see of the targets: what is missing, from where the body stands and faces."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from controlmm.models.control_branch import ControlBranch, ControlBranchConfig
from controlmm.models.missing_path import missing_in_heading, slopes
from controlmm.models.residual_control import ResidualControl, ResidualControlConfig

TURNED = 1e-5  # m and m/s: float32 sines of an angle


def test_slopes_are_those_of_the_line_through_what_is_known():
    """From 0 at frame 0 to 4 at frame 2 (2 a frame), to 1 at frame 5 (-1 a frame), flat from there."""
    values, mask = torch.zeros(1, 7, 1, 3), torch.zeros(1, 7, 1, 3, dtype=torch.bool)
    values[0, 2], values[0, 5] = 4.0, 1.0
    mask[0, [2, 5], 0, 0] = True
    found = slopes(values, mask)
    assert found[0, :, 0, 0].tolist() == [2, 2, -1, -1, -1, 0, 0]
    assert not found[..., 1:].any()  # without a target there is nothing to go to
    mask[0, 0, 0, 0] = True
    values[0, 0] = 2.0  # a target in frame 0 takes the place of the origin
    assert slopes(values, mask)[0, :2, 0, 0].tolist() == [1, 1]


def test_dense_slopes_are_the_steps():
    values = torch.randn(2, 9, 3, 3, generator=torch.Generator().manual_seed(2))
    found = slopes(values, torch.ones_like(values, dtype=torch.bool))
    torch.testing.assert_close(found[:, :-1], values.diff(dim=1))
    assert not found[:, -1].any()


def test_what_is_missing_is_seen_from_the_body(walking_joints, yawed):
    """Somebody should be a metre further on the way that the body faces: forward is +Z, wherever that is."""
    current = yawed(walking_joints[:8], math.pi / 2).float()[None]
    mask = torch.zeros_like(current, dtype=torch.bool)
    mask[0, 5, 0] = True
    ahead = math.atan2(*[float(x) for x in _forward(current[0, 5])])
    step = torch.tensor([math.sin(ahead), 0.0, math.cos(ahead)])
    missing, speed = missing_in_heading(current + step, mask, current, metres=1.0, fps=20.0)
    torch.testing.assert_close(missing[0, 5, 0], torch.tensor([0.0, 0.0, 1.0]), rtol=0, atol=TURNED)
    assert speed[0, :5, 0].norm(dim=1).tolist() == pytest.approx([20 / 5] * 5, abs=TURNED)
    assert not missing[0, 6:].any()
    assert not missing[0, :, 1:].any()
    assert not speed[0, 5:].any()


def test_turning_the_scene_changes_nothing(walking_joints, yawed):
    current = walking_joints[:16].float()[None]
    targets, mask = goals(16)
    turned = [yawed(points[0].double(), 1.1).float()[None] for points in (targets, current)]
    as_it_is = missing_in_heading(targets, mask, current, metres=1.0, fps=20.0)
    as_turned = missing_in_heading(turned[0], mask, turned[1], metres=1.0, fps=20.0)
    for one, other in zip(as_it_is, as_turned, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-4)


def test_millimetres_at_another_rate_are_metres_and_seconds(walking_joints):
    current = walking_joints[:16].float()[None]
    targets, mask = goals(16)
    metres = missing_in_heading(targets, mask, current, metres=1.0, fps=20.0)
    other = missing_in_heading(1000 * targets, mask, 1000 * current, metres=0.001, fps=12.5)
    torch.testing.assert_close(other[0], metres[0], rtol=0, atol=TURNED)
    torch.testing.assert_close(other[1], metres[1] * 12.5 / 20, rtol=1e-5, atol=TURNED)


# --- the signals that are made of it ---


def test_the_residual_layers_see_what_is_missing_its_speed_and_the_mask(walking_joints):
    network = ResidualControl(ResidualControlConfig.tiny())
    current, (targets, mask) = walking_joints[:16].float()[None], goals(16)
    missing, speed = missing_in_heading(targets, mask, current, metres=1.0, fps=20.0)
    expected = torch.cat([part.flatten(2) for part in (missing, speed, mask.float())], dim=-1)
    assert torch.equal(network.signal(targets, mask, current), expected)


def test_strength_counts_for_the_speed_alone(walking_joints):
    network = ResidualControl(ResidualControlConfig.tiny())
    current, (targets, mask) = walking_joints[:16].float()[None], goals(16)
    plain = network.signal(targets, mask, current).chunk(3, dim=-1)
    strong = network.signal(targets, mask, current, strength=4.0).chunk(3, dim=-1)
    assert plain[1].any()
    assert torch.equal(strong[1], 4 * plain[1])
    assert strong[0].equal(plain[0])
    assert strong[2].equal(plain[2])


@pytest.mark.parametrize("has_mask", [True, False])
@pytest.mark.parametrize("sees_speed", [True, False])
def test_the_control_branch_sees_differences_targets_and_what_its_configuration_adds(
    walking_joints, has_mask, sees_speed
):
    config = replace(
        ControlBranchConfig.tiny(),
        joints=(0, 20),
        has_observation_mask=has_mask,
        sees_missing_speed=sees_speed,
    )
    current, (targets, mask) = walking_joints[:16].float()[None], goals(16)
    found = ControlBranch(config).signal(targets, mask, current)
    parts = [torch.where(mask, targets - current, 0.0), torch.where(mask, targets, 0.0)]
    parts += [mask.float()] * has_mask
    parts += list(missing_in_heading(targets, mask, current, metres=1.0, fps=20.0)) * sees_speed
    assert torch.equal(found, torch.cat([part[:, :, [0, 20]].flatten(2) for part in parts], dim=-1))
    assert found.shape[-1] == config.signal_dim


def test_a_configuration_from_before_the_speed_was_seen_does_not_see_it():
    """Folders that were saved without the field load as they were trained."""
    assert not ControlBranchConfig(width=16, heads=2).sees_missing_speed
    assert ControlBranchConfig.small().sees_missing_speed
    assert not ControlBranchConfig.published().sees_missing_speed


def goals(frames: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Pelvis targets on some frames."""
    targets = torch.randn(1, frames, 22, 3, generator=torch.Generator().manual_seed(1))
    mask = torch.zeros(1, frames, 22, 3, dtype=torch.bool)
    mask[:, [3, 9, 14], 0] = True
    return targets, mask


def _forward(pose: torch.Tensor) -> torch.Tensor:
    """(x, z) at a right angle to hips and shoulders, which point to the left."""
    across = pose[1] - pose[2] + pose[16] - pose[17]
    return torch.stack([-across[2], across[0]])
