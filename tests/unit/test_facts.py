"""Facts about motions, on motions made by hand whose facts are known."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import pytest
import torch

from controlmm.evaluation.facts import holds, measured_facts, mirrored_expectation, missed
from controlmm.motion.mirror import mirror_joints
from controlmm.motion.skeleton import HUMANML3D

ROOT = Path(__file__).resolve().parents[2]
FPS = 20
SHARE = 1e-6  # of an even way, which smoothing leaves as it is


def standing(frames: int = 60) -> torch.Tensor:
    """(T, 22, 3) metres: the rest pose facing +Z with hanging arms."""
    pose = torch.zeros(22, 3, dtype=torch.float64)
    for joint, parent in enumerate(HUMANML3D.parents[1:], start=1):
        pose[joint] = pose[parent] + HUMANML3D.rest_offsets()[joint]
    for shoulder, elbow, wrist in ((16, 18, 20), (17, 19, 21)):
        pose[elbow] = pose[shoulder] - torch.tensor([0, 0.26, 0])
        pose[wrist] = pose[elbow] - torch.tensor([0, 0.25, 0])
    pose[:, 1] -= pose[:, 1].min()
    return pose.repeat(frames, 1, 1)


def time(frames: int = 60) -> torch.Tensor:
    return torch.arange(frames, dtype=torch.float64) / FPS


def test_somebody_who_stands_does_nothing():
    facts = measured_facts(standing())
    assert all(abs(value) < 1e-9 for name, value in facts.items() if name != "bow")
    assert abs(facts["bow"]) < 5  # the rest pose is a little bent


def test_walking_ahead_and_sideways():
    """1.2 m/s along +Z for 3 s; then 0.5 m/s to the body's left, +X."""
    ahead, aside = standing(), standing()
    ahead[..., 2] += 1.2 * time()[:, None]
    aside[..., 0] += 0.5 * time()[:, None]
    facts = measured_facts(ahead)
    assert facts["forward"] == pytest.approx(1.2 * 55 / FPS, rel=SHARE)
    assert facts["speed"] == pytest.approx(1.2, rel=SHARE)
    assert facts["forward_speed"] == pytest.approx(1.2, rel=SHARE)
    assert facts["leftward"] == pytest.approx(0, abs=1e-9)
    facts = measured_facts(aside)
    assert facts["leftward"] == pytest.approx(0.5 * 55 / FPS, rel=SHARE)
    assert facts["leftward_speed"] == pytest.approx(0.5, rel=SHARE)
    assert facts["forward_speed"] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("degrees", [90, -135, 360])
def test_turns_are_signed_and_go_on_past_half_a_turn(degrees, yawed):
    facts = measured_facts(yawed(standing(100), torch.linspace(0, math.radians(degrees), 100)[:, None]))
    assert facts["turn"] == pytest.approx(degrees, rel=0.05)
    assert facts["turned"] == pytest.approx(abs(degrees), rel=0.05)


def test_walking_backwards_while_facing_somewhere_else(yawed):
    """The body faces 60 degrees to the left of +Z and moves against its own facing."""
    joints = yawed(standing(), math.radians(60))
    direction = torch.tensor([math.sin(math.radians(60)), 0, math.cos(math.radians(60))])
    joints = joints - 0.4 * time()[:, None, None] * direction
    facts = measured_facts(joints)
    assert facts["forward_speed"] == pytest.approx(-0.4, rel=SHARE)
    assert facts["leftward_speed"] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("side", "wrist", "shoulder"), [("left", 20, 16), ("right", 21, 17)])
def test_a_hand_goes_up_for_a_second_and_swings(side, wrist, shoulder):
    """Over the head from frame 20 to 40, swinging 10 cm to either side with 2 Hz: a turn every 5 frames."""
    joints, other = standing(), {"left": "right", "right": "left"}[side]
    up = slice(20, 40)
    joints[up, wrist] = joints[up, shoulder] + torch.tensor([0, 0.5, 0])
    joints[up, wrist, 0] += 0.1 * torch.sin(2 * math.pi * 2 * time()[up])
    facts = measured_facts(joints)
    assert facts[f"{side}_hand_up"] == pytest.approx(1.0)
    assert facts[f"{side}_hand_overhead"] == pytest.approx(1.0)
    assert facts[f"{side}_hand_swings"] in (3, 4)
    assert facts[f"{other}_hand_up"] == facts[f"{other}_hand_swings"] == 0


def test_a_still_raised_hand_does_not_swing():
    joints = standing()
    joints[:, 20] = joints[:, 16] + torch.tensor([0, 0.5, 0])
    joints[:, 20, 0] += 0.01 * torch.sin(20 * time())
    assert measured_facts(joints)["left_hand_swings"] == 0


def test_a_jump_lifts_both_feet_and_a_kick_one():
    jump, kick = standing(), standing()
    jump[20:28, :, 1] += 0.3
    kick[20:28, [8, 11], 1] += 0.6
    facts = measured_facts(jump)
    assert facts["jump"] == pytest.approx(0.3)
    assert max(facts["left_foot_lift"], facts["right_foot_lift"]) < 0.1  # both feet are in the air
    facts = measured_facts(kick)
    assert facts["right_foot_lift"] == pytest.approx(0.6)
    assert facts["left_foot_lift"] == facts["jump"] == 0


def test_a_bow_leans_the_trunk_and_a_crouch_lowers_the_pelvis():
    bow, crouch = standing(), standing()
    neck = bow[0, 12] - bow[0, 0]
    angle = math.radians(60)
    turned = torch.tensor([neck[0], neck[1] * math.cos(angle), neck[1] * math.sin(angle)])
    bow[20:40, 12] = bow[20:40, 0] + turned
    assert measured_facts(bow)["bow"] == pytest.approx(60, abs=0.1)
    crouch[20:40, :, 1] *= 0.6
    crouch[20:40, 12] = crouch[20:40, 0] + turned
    facts = measured_facts(crouch)
    assert facts["lowering"] == pytest.approx(0.4 * float(crouch[0, 0, 1]))
    assert facts["bow"] < 5  # bent legs: no bow


def test_the_mirror_image_has_the_mirrored_facts(walk):
    joints = walk(80, turn=1.0).double()
    joints[30:60, 20] = joints[30:60, 16] + torch.tensor([0, 0.4, 0], dtype=torch.float64)
    facts, mirrored = measured_facts(joints), measured_facts(mirror_joints(joints))
    for name, value in facts.items():
        (other,) = mirrored_expectation({name: (value, value)}).items()
        assert mirrored[other[0]] == pytest.approx(other[1][0], abs=1e-6), name


def test_expectations_are_ranges_with_open_ends():
    facts = {"turn": 80.0, "left_hand_up": 0.2}
    assert holds(facts, {"turn": (45, 135)})
    assert holds(facts, {"turn": (45, None), "left_hand_up": (None, 0.4)})
    assert missed(facts, {"turn": (None, 45), "left_hand_up": (0.5, None)}) == ["turn", "left_hand_up"]
    expected = {"turn": (45, None), "left_hand_up": (0.5, None), "right_hand_up": (None, 0.4)}
    mirrored = {"turn": (None, -45), "right_hand_up": (0.5, None), "left_hand_up": (None, 0.4)}
    assert mirrored_expectation(expected) == mirrored


def test_motions_of_other_skeletons_are_refused():
    with pytest.raises(
        ValueError, match=r"`joints` must have shape \(T, 22, 3\), T at least 10, got \(60, 21, 3\)"
    ):
        measured_facts(torch.zeros(60, 21, 3))
    with pytest.raises(ValueError, match="T at least 10, got"):
        measured_facts(torch.zeros(9, 22, 3))


@pytest.fixture
def free_prompts(monkeypatch):
    """The benchmark's module, from the source tree."""
    if not (ROOT / "benchmarks" / "free_prompts.py").is_file():
        pytest.skip("the benchmarks are not part of this installation")
    monkeypatch.syspath_prepend(str(ROOT))
    import benchmarks.free_prompts as module

    yield module
    sys.modules.pop("benchmarks.free_prompts", None)


def test_there_are_sixty_prompts_whose_facts_exist(free_prompts):
    prompts = free_prompts.load_prompts()
    names = measured_facts(standing()).keys()
    assert len({prompt.prompt for prompt in prompts}) == 60
    for prompt in prompts:
        assert prompt.expect.keys() <= names
        assert 1 <= prompt.seconds <= 9.8
        assert prompt.mirrored().mirrored() == prompt
        says_side = any(
            word in prompt.prompt.split() for word in ("left", "right", "leftwards", "rightwards")
        )
        assert says_side == (prompt.mirrored().prompt != prompt.prompt)


def test_no_prompt_is_a_caption(free_prompts, shared):
    captions = []
    for line in (shared / "data" / "captions.jsonl").read_text().splitlines():
        captions += json.loads(line)["captions"]
    prompts = free_prompts.load_prompts()
    assert free_prompts.known_captions(prompts, captions) == []
    assert free_prompts.known_captions(prompts, [prompts[3].prompt.upper() + "."]) == [prompts[3].prompt]


def test_prompts_are_asked_and_counted(free_prompts, tiny_pipeline):
    prompt = free_prompts.FreePrompt("somebody walks", 1.0, {"speed": (None, None), "jump": (None, -1.0)})
    rows = free_prompts.misses(tiny_pipeline, prompt, samples=2, seed=0)
    assert rows == [["jump"], ["jump"]]
