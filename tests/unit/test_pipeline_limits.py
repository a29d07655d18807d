"""Tolerance and time of a call, and targets that are moved afterwards."""

from __future__ import annotations

import pytest
import torch

from controlmm.controls import JointControl
from controlmm.generation.editing import EditingBudget
from controlmm.pipelines import PRESETS, Preset
from controlmm.pipelines.presets import with_limits

QUICK = Preset(EditingBudget(solver="auto", latent_iterations=40, tolerance=0.003), steps=2)


@pytest.mark.parametrize(
    ("given", "metres"), [("1mm", 0.001), (" 2.5 cm", 0.025), ("1e-2m", 0.01), (0.004, 0.004), (1, 1.0)]
)
def test_tolerances_have_units(given, metres):
    assert with_limits(PRESETS["fast"], tolerance=given).budget.tolerance == pytest.approx(metres)


@pytest.mark.parametrize(("given", "seconds"), [("200ms", 0.2), ("1.5s", 1.5), (0.3, 0.3)])
def test_time_budgets_have_units(given, seconds):
    assert with_limits(PRESETS["fast"], time_budget=given).budget.time_budget == pytest.approx(seconds)


def test_without_limits_a_preset_stays():
    assert with_limits(PRESETS["accurate"]) == PRESETS["accurate"]


@pytest.mark.parametrize("value", ["5 inches", "mm", "-1mm", "", 0, -0.1, float("nan"), True, "1..5mm"])
def test_unusable_tolerances_are_refused(value, tiny_pipeline):
    with pytest.raises(ValueError, match="`tolerance` must be a positive number of m or text such as '5mm'"):
        tiny_pipeline("a person walks", frames=16, tolerance=value)


def test_a_time_budget_is_refused_when_it_is_no_time(tiny_pipeline):
    with pytest.raises(
        ValueError, match="`time_budget` must be a positive number of s or text such as '5ms'"
    ):
        tiny_pipeline("a person walks", frames=16, time_budget="5 mm")


def test_a_tighter_tolerance_ends_nearer(tiny_pipeline):
    control = JointControl("pelvis", frames=[12], positions=[[0.1, 0.95, 0.2]])
    errors = [
        tiny_pipeline("walk", frames=16, controls=[control], preset=QUICK, tolerance=tolerance).control_error
        for tolerance in ("20cm", "3mm")
    ]
    assert errors[1] <= errors[0]
    assert errors[1] < 0.05


def on_ground(frame: int, point: torch.Tensor) -> JointControl:
    """The pelvis over a point, its height left free."""
    return JointControl("pelvis", frames=[frame], positions=[[point[0].item(), None, point[2].item()]])


@pytest.fixture
def walked(tiny_pipeline):
    controls = [on_ground(0, torch.tensor([2.0, 0.0, 1.0])), on_ground(12, torch.tensor([2.1, 0.0, 1.2]))]
    return tiny_pipeline, tiny_pipeline("walk", frames=16, controls=controls, preset=QUICK, samples=2)


def test_a_moved_target_is_met_from_where_the_result_stands(walked):
    pipeline, result = walked
    wanted = result[0].joints[10, 0] + torch.tensor([0.02, 0.0, 0.02])
    target = on_ground(10, wanted)
    adjusted = pipeline.adjust(result, [target], tolerance=0.005)
    assert len(adjusted) == 2
    assert adjusted.control_error[0] < 0.005
    assert (adjusted[0].joints[0, 0, [0, 2]] - torch.tensor([2.0, 1.0])).abs().max() < 1e-5
    assert adjusted[0].text == result[0].text


def test_adjusting_to_where_it_is_changes_nothing(walked):
    pipeline, result = walked
    target = on_ground(10, result[0].joints[10, 0])
    adjusted = pipeline.adjust(result, [target])
    assert torch.equal(adjusted.latents[0], result.latents[0])


def test_held_frames_stay_as_they_are(walked):
    pipeline, result = walked
    wanted = result[0].joints[14, 0] + torch.tensor([0.02, 0.0, 0.02])
    target = on_ground(14, wanted)
    adjusted = pipeline.adjust(result, [target], hold_frames=6)
    ground = torch.tensor([0, 2])
    assert torch.equal(adjusted[0].joints[:6], result[0].joints[:6])
    assert (adjusted[0].joints[14, 0] - wanted)[ground].abs().max() < 1e-4


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"hold_frames": 16}, ValueError, "`hold_frames` must be a whole number from 0 to 15, got 16"),
        ({"hold_frames": 1.5}, ValueError, "`hold_frames` must be a whole number"),
        ({"tolerance": 0.0}, ValueError, "`tolerance` must be a positive number of metres, got 0.0"),
    ],
)
def test_unusable_adjustments_are_refused(walked, changes, error, message):
    pipeline, result = walked
    with pytest.raises(error, match=message):
        pipeline.adjust(result, [], **changes)


def test_only_results_can_be_adjusted(walked):
    pipeline, result = walked
    with pytest.raises(TypeError, match="`result` must be what a call of the pipeline returned, got Motion"):
        pipeline.adjust(result[0], [])
