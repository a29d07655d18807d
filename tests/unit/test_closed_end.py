"""The end of a call: joints on their targets, bones of the right length, in all that a pipeline makes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from controlmm.controls import JointControl, Sphere, TimelineEntry
from controlmm.motion.features import bone_lengths
from controlmm.motion.skeleton import HUMANML3D
from controlmm.pipelines import PRESETS, Preset

TENTH_OF_A_MILLIMETRE, MILLIMETRE = 1e-4, 1e-3
LENGTHS = HUMANML3D.rest_offsets().norm(dim=-1)
OURS = ("fast", "balanced", "accurate", "exact")


def quick(name: str) -> Preset:
    preset = PRESETS[name]
    return replace(preset, steps=2, budget=replace(preset.budget, latent_iterations=6))


def bone_error(motion) -> float:
    return float((bone_lengths(motion.joints, HUMANML3D) - LENGTHS)[:, 1:].abs().max())


@pytest.fixture
def walk(tiny_pipeline):
    """A motion with whole bones, of a body as the skeleton's."""
    return tiny_pipeline("a person walks", frames=24, preset=quick("fast")).best


@pytest.mark.parametrize("name", OURS)
def test_targets_are_met_with_whole_bones(tiny_pipeline, name):
    controls = [
        JointControl("right_wrist", frames=[9], positions=[[-0.3, 1.2, 0.2]]),
        JointControl("pelvis", frames=[14], positions=[[0.1, 0.9, 0.3]]),
    ]
    result = tiny_pipeline("a person reaches", frames=16, controls=controls, preset=quick(name), samples=2)
    assert result.control_error.max() < TENTH_OF_A_MILLIMETRE
    assert max(bone_error(motion) for motion in result) < MILLIMETRE
    assert len(result.exact) == 2


def test_text_alone_has_whole_bones(tiny_pipeline):
    result = tiny_pipeline("a person walks", frames=20, preset=quick("balanced"), samples=2)
    assert max(bone_error(motion) for motion in result) < MILLIMETRE
    assert all(report.bone_error[0] > 10 * MILLIMETRE for report in result.exact)


def test_the_papers_presets_leave_motions_as_they_decode(tiny_pipeline):
    plan = quick("paper-fast")
    result = tiny_pipeline("a person walks", frames=20, preset=plan)
    assert result.exact == ()
    decoded = tiny_pipeline.decoder.clip_features(result.latents)[0]
    assert torch.equal(result.best.features[:, 1:3], decoded[:, 1:3])


def test_what_bones_cannot_span_stays_off_its_target_and_the_rest_is_met(tiny_pipeline):
    controls = [
        JointControl("pelvis", frames=[4, 12], positions=[[0.0, 0.9, 0.0], [0.1, 0.9, 0.2]]),
        JointControl("left_wrist", frames=[4], positions=[[3.0, 0.9, 0.0]]),
    ]
    with pytest.warns(UserWarning, match="ask for the impossible"):
        result = tiny_pipeline("reach", frames=16, controls=controls, preset=quick("fast"))
    joints = result.best.joints
    assert bone_error(result.best) < MILLIMETRE
    assert (joints[4, 20, 0] - joints[4, 0, 0]).abs() < 1.2
    assert (joints[12, 0] - torch.tensor([0.1, 0.9, 0.2])).abs().max() < TENTH_OF_A_MILLIMETRE


def test_beside_obstacles_latents_do_all_unless_the_preset_is_exact(tiny_pipeline):
    control = JointControl("pelvis", frames=[14], positions=[[0.1, 0.9, 0.3]])
    ball = Sphere((2.0, 0.5, 2.0), 0.3)
    for name, closes in (("balanced", False), ("exact", True)):
        result = tiny_pipeline("walk", frames=16, controls=[control], obstacles=[ball], preset=quick(name))
        assert bool(result.exact) == closes
        assert bool(result.control_error.max() < TENTH_OF_A_MILLIMETRE) == closes


def test_adjusted_results_are_on_the_new_targets(tiny_pipeline, walk):
    result = tiny_pipeline("a person walks", frames=24, preset=quick("fast"))
    assert torch.equal(result.best.joints, walk.joints)
    wanted = result.best.joints[20, 0] + torch.tensor([0.05, 0.0, 0.05])
    target = JointControl("pelvis", frames=[20], positions=[wanted.tolist()])
    adjusted = tiny_pipeline.adjust(result, [target])
    assert adjusted.control_error.max() < TENTH_OF_A_MILLIMETRE
    assert len(adjusted.exact) == 1


def test_clips_of_a_chain_fit_exactly(tiny_pipeline):
    clips = [("a person walks", 1.0), ("a person bows", 1.2)]
    result = tiny_pipeline.chain(clips, overlap=0.4, preset=quick("fast"))
    assert result.control_error.max() < TENTH_OF_A_MILLIMETRE
    assert bone_error(result.best) < MILLIMETRE


@pytest.mark.parametrize("options", [{"keep": [(0.0, 0.4)]}, {"keep_parts": ["lower"]}, {}])
def test_edits_keep_what_stays_to_a_tenth_of_a_millimetre(tiny_pipeline, walk, options):
    result = tiny_pipeline.edit(walk, "a person jumps", preset=quick("fast"), **options)
    assert result.control_error.max() < TENTH_OF_A_MILLIMETRE
    assert bone_error(result.best) < MILLIMETRE


def test_edits_keep_the_size_of_the_body(tiny_pipeline, walk):
    """A motion of a body ten per cent larger: its bones are kept, not the skeleton's."""
    large = replace(walk, joints=1.1 * walk.joints, features=None)
    result = tiny_pipeline.edit(large, "a person jumps", keep=[(0.0, 0.4)], preset=quick("fast"))
    lengths = bone_lengths(result.best.joints, HUMANML3D)[:, 1:]
    assert (lengths - 1.1 * LENGTHS[1:]).abs().max() < MILLIMETRE


def test_timelines_have_whole_bones(tiny_pipeline):
    entries = [
        TimelineEntry("lower", "a person walks", frames=(0, 24)),
        TimelineEntry("upper", "a person waves", frames=(8, 24)),
    ]
    control = JointControl("pelvis", frames=[20], positions=[[0.1, None, 0.3]])
    result = tiny_pipeline.timeline(entries, controls=[control], preset=quick("fast"))
    assert bone_error(result.best) < MILLIMETRE
    reached = result.best.joints[20, 0, [0, 2]] - torch.tensor([0.1, 0.3])
    assert reached.abs().max() < TENTH_OF_A_MILLIMETRE


@pytest.mark.parametrize("value", [0.0, -0.1, float("nan"), "1cm"])
def test_unusable_distances_are_refused(value):
    with pytest.raises(ValueError, match="`closes_from` must be a positive number of metres or None"):
        replace(PRESETS["fast"], closes_from=value)


def test_an_exact_preset_needs_a_closed_end():
    with pytest.raises(ValueError, match="`is_exact` needs `closes_from`"):
        replace(PRESETS["exact"], closes_from=None)
