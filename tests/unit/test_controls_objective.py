"""Objectives of one's own: what a function of the joints may be, and what is said of one that may not."""

from __future__ import annotations

import pytest
import torch

from controlmm.controls import Objective

POSES = torch.rand(2, 6, 22, 3, generator=torch.Generator().manual_seed(0))


def hand_distance(joints):
    return (joints[:, :, 20] - joints[:, :, 21]).square().sum(-1).mean(1)


def test_a_function_with_a_value_for_each_clip_is_called_with_all():
    objective = Objective(hand_distance, weight=2.0)
    assert objective.check(POSES)
    assert objective.name == "hand_distance"
    torch.testing.assert_close(objective.values(POSES, is_batched=True), 2 * hand_distance(POSES))


def test_a_scalar_function_is_called_clip_by_clip():
    calls = []

    def scalar(joints):
        calls.append(len(joints))
        return hand_distance(joints).sum()

    objective = Objective(scalar)
    assert not objective.check(POSES)
    calls.clear()
    torch.testing.assert_close(objective.values(POSES, is_batched=False), hand_distance(POSES))
    assert calls == [1, 1]


@pytest.mark.parametrize(
    ("fn", "kind", "message"),
    [
        (
            lambda j: j.mean((1, 2)),
            ValueError,
            r"must return shape \(B,\) = \(2,\) or a scalar, got \(2, 3\)",
        ),
        (lambda j: 3.0, TypeError, r"must return a tensor, got float"),
        (lambda j: j.detach().sum((1, 2, 3)), ValueError, r"has no gradient: .* Avoid numpy\(\), detach\(\)"),
        (lambda j: j.sum((1, 2, 3)) * torch.nan, ValueError, r"gives NaN or infinity on a standing pose"),
        (
            lambda j: (j - j.detach()).norm(dim=-1).sqrt().sum((1, 2)),
            ValueError,
            r"gradient .* add a small number",
        ),
        (lambda j: j.sum((1, 2, 3)) - j.mean(), ValueError, r"mixes clips"),
    ],
)
def test_unusable_functions_are_refused(fn, kind, message):
    with pytest.raises(kind, match=message):
        Objective(fn, name="mine").check(POSES)


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        ({"fn": 3}, TypeError, r"`fn` must be callable, got int"),
        ({"fn": hand_distance, "weight": "1"}, TypeError, r"`weight` must be a number, got str"),
        ({"fn": hand_distance, "weight": 0}, ValueError, r"`weight` must be positive and finite, got 0"),
    ],
)
def test_bad_arguments_are_refused(arguments, kind, message):
    with pytest.raises(kind, match=message):
        Objective(**arguments)
