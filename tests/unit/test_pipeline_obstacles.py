"""Obstacles and objectives of a call: avoided, reported, refused; also without any control."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from controlmm.controls import Avoid, JointControl, Objective, PathControl, Sphere
from controlmm.generation.editing import EditingBudget
from controlmm.motion.motion import Motion
from controlmm.pipelines import Preset

PROMPT = "a person walks forward"
EDITED = Preset(EditingBudget(logits_iterations=0, latent_iterations=150), steps=3)
UNEDITED = Preset(EditingBudget(logits_iterations=0, latent_iterations=0), steps=3)
BOTH = Preset(EditingBudget(logits_iterations=5, latent_iterations=100), steps=3)


def ball_in_the_way(pipeline, **options):
    """A ball around the middle pelvis of what the call would give without it."""
    free = pipeline(PROMPT, frames=24, preset=UNEDITED, seed=1).best
    return Avoid(Sphere(free.joints[12, 0], 0.15), joints=["pelvis"], **options)


@pytest.mark.parametrize("preset", [EDITED, BOTH], ids=["latents", "logits and latents"])
def test_joints_leave_an_obstacle_without_any_control(tiny_pipeline, preset):
    ball = ball_in_the_way(tiny_pipeline)
    before = tiny_pipeline(PROMPT, frames=24, obstacles=[ball], preset=UNEDITED, seed=1)
    after = tiny_pipeline(PROMPT, frames=24, obstacles=[ball], preset=preset, seed=1)
    assert before.penetration.item() > 0.1
    assert not before.is_free.any()
    assert after.penetration.item() < 0.2 * before.penetration.item()
    assert after.control_error.item() == 0


def test_the_control_branch_stays_off_without_targets(tiny_pipeline, monkeypatch):
    def never(*args, **kwargs):
        raise AssertionError("the control branch ran")

    monkeypatch.setattr(type(tiny_pipeline.control), "forward", never)
    monkeypatch.setattr(type(tiny_pipeline.control), "signal", never)
    for preset in (EDITED, BOTH):
        tiny_pipeline(PROMPT, frames=16, obstacles=[Sphere((0, 0.9, 0.3), 0.2)], preset=preset)


def test_penetration_is_measured_on_the_motions_returned(tiny_pipeline):
    """Against NumPy, for a ball that moves; the margin does not count, the joint's radius does."""
    centers = np.linspace([0, 0.8, 0], [0, 1.2, 0.4], 24)
    ball = Avoid(Sphere(torch.tensor(centers), 0.3), joints=["head", 0], margin=0.5, joint_radius=0.1)
    result = tiny_pipeline(PROMPT, frames=24, obstacles=[ball], preset=UNEDITED, samples=2)
    for motion, depth in zip(result, result.penetration, strict=True):
        distance = np.linalg.norm(motion.joints[:, [0, 15]].double().numpy() - centers[:, None], axis=-1)
        assert depth.item() == pytest.approx(max(0.0, (0.4 - distance).max()), abs=1e-5)
        assert motion.extra["obstacles"] == (ball,)


def test_the_scene_moves_with_the_start_of_the_body(tiny_pipeline):
    """The same call 3 m aside: the same motion 3 m aside."""
    offset = torch.tensor([3.0, 0.0, -1.0])
    ball = ball_in_the_way(tiny_pipeline)
    motions = []
    for shift in (0 * offset, offset):
        start = JointControl("pelvis", frames=[0], positions=(torch.tensor([[0.0, 0.9, 0.0]]) + shift))
        motions.append(
            tiny_pipeline(
                PROMPT, frames=24, controls=[start], obstacles=[ball.moved(shift)], preset=EDITED
            ).best
        )
    torch.testing.assert_close(motions[0].joints + offset, motions[1].joints, rtol=0, atol=0.02)


def test_the_best_sample_is_free_before_it_is_near(tiny_pipeline):
    path = PathControl("pelvis", xz=[[0, 0], [0, 1]])
    result = tiny_pipeline(
        PROMPT,
        frames=24,
        controls=[path],
        obstacles=[ball_in_the_way(tiny_pipeline)],
        preset=UNEDITED,
        samples=3,
    )
    assert result.best is result[int((result.control_error + result.penetration).argmin())]


def test_an_objective_is_made_small(tiny_pipeline):
    def height_of_the_head(joints):
        return (joints[:, :, 15, 1] - 1.0).square().mean(1)

    results = [
        tiny_pipeline(PROMPT, frames=24, objectives=[Objective(height_of_the_head)], preset=preset)
        for preset in (UNEDITED, EDITED)
    ]
    before, after = (height_of_the_head(result.best.joints[None]).item() for result in results)
    assert after < 0.2 * before


def test_obstacles_survive_npz(tiny_pipeline, tmp_path):
    moving = Avoid(Sphere([[0, 1, 0], [1, 1, 1]], 0.2), frames=[0, 10], joints=["head"], margin=0.1)
    motion = tiny_pipeline(PROMPT, frames=16, obstacles=[moving], preset=UNEDITED).best
    (again,) = Motion.load(motion.save(tmp_path / "a.npz")).extra["obstacles"]
    assert torch.equal(again.shape.center, moving.shape.center)
    assert (again.joints, again.margin, again.frames.tolist()) == (("head",), 0.1, [0, 10])


BALL = Sphere((0, 1, 2), 0.5)


@pytest.mark.parametrize(
    ("options", "kind", "message"),
    [
        (
            {"controls": [JointControl("head", [9], [[0, 1, 2.2]])], "obstacles": [BALL]},
            ValueError,
            r"The target of head at frame 9 lies 0\.300 m inside obstacle 0 \(sphere\), which that",
        ),
        ({"obstacles": [Avoid(BALL), 3]}, TypeError, r"`obstacles\[1\]` must be a shape such as Sphere"),
        (
            {"obstacles": [Sphere([[0, 0, 0]] * 9, 1)]},
            ValueError,
            r"moves over 9 frames, but the clip has 24",
        ),
        (
            {"objectives": [torch.sum]},
            TypeError,
            r"`objectives\[0\]` must be an Objective, .* Objective\(fn\)",
        ),
        ({"objectives": Objective(torch.sum)}, TypeError, r"`objectives` must be a list of Objective"),
        ({"objectives": [Objective(lambda j: j.detach().sum())]}, ValueError, r"has no gradient"),
    ],
)
def test_impossible_scenes_are_refused(tiny_pipeline, monkeypatch, options, kind, message):
    def never(*args, **kwargs):
        raise AssertionError("a network ran")

    monkeypatch.setattr(tiny_pipeline, "generate_latents", never)
    monkeypatch.setattr(type(tiny_pipeline.text_encoder), "encode", never)
    with pytest.raises(kind, match=message):
        tiny_pipeline(PROMPT, frames=24, **options)


def test_a_target_within_a_margin_is_warned_of(tiny_pipeline):
    near = JointControl("head", [9], [[0, 1, 2.53]])
    with pytest.warns(UserWarning, match=r"head at frame 9 is 0\.030 m from obstacle 0 .* margin of 0\.05 m"):
        tiny_pipeline(PROMPT, frames=24, controls=[near], obstacles=[BALL], preset=UNEDITED)
    elsewhere = Avoid(BALL, joints=["pelvis"])  # another joint may be there
    tiny_pipeline(PROMPT, frames=24, controls=[near], obstacles=[elsewhere], preset=UNEDITED)
