"""Swapping left and right in words; joints and features are covered with the representation."""

from __future__ import annotations

import json

import pytest
import torch

from controlmm.motion.mirror import mirror_features, mirror_joints, mirror_text


@pytest.mark.parametrize(
    ("text", "mirrored"),
    [
        ("A person raises the left hand.", "a person raises the right hand."),
        ("turns right, then left", "turns left, then right"),
        ("left-handed throw to the right-hand side", "right-handed throw to the left-hand side"),
        ("walks in a clockwise circle", "walks in a counterclockwise circle"),
        ("spins counter-clockwise", "spins clockwise"),
        ("spins anticlockwise", "spins clockwise"),
        ("rightwards, leftmost", "leftwards, rightmost"),
        ("turns at a right angle and stops right away", "turns at a right angle and stops right away"),
        ("has no energy left in the left leg", "has no energy left in the right leg"),
        ("is all right with her right arm", "is all right with her left arm"),
        ("a bright, upright person", "a bright, upright person"),
    ],
)
def test_words_for_sides_are_swapped_and_phrases_kept(text, mirrored):
    assert mirror_text(text) == mirrored


def test_mirroring_a_text_twice_gives_it_back():
    text = "steps left, spins clockwise to the right and leans rightward"
    assert mirror_text(mirror_text(text)) == text


def test_the_published_word_list_is_followed(shared):
    table = json.loads((shared / "data" / "mirror_words.json").read_text(encoding="utf-8"))
    for word, other in table["words"].items():
        assert mirror_text(f"the {word} of it") == f"the {other} of it"
    for phrase in table["keep"]:
        assert mirror_text(f"it is {phrase}, so") == f"it is {phrase}, so"


def test_mirroring_joints_and_features_twice_gives_them_back():
    generator = torch.Generator().manual_seed(0)
    joints, features = torch.randn(4, 22, 3, generator=generator), torch.randn(4, 263, generator=generator)
    kit = torch.randn(4, 251, generator=generator)
    for value, mirror in ((joints, mirror_joints), (features, mirror_features), (kit, mirror_features)):
        assert torch.equal(mirror(mirror(value)), value)
        assert not torch.equal(mirror(value), value)


def test_mirrored_left_wrist_is_the_reflected_right_wrist():
    joints = torch.randn(3, 22, 3, generator=torch.Generator().manual_seed(1))
    assert torch.equal(mirror_joints(joints)[:, 20], joints[:, 21] * torch.tensor([-1.0, 1.0, 1.0]))
