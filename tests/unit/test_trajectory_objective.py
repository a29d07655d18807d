"""What TLControl's optimisation minimises: forms of the loss, foot terms, units of the latents."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from controlmm.generation.foot_terms import ContactTerm, PublishedFootTerm
from controlmm.generation.trajectory_objective import LOSS_FORMS, Rescaled, trajectory_objective
from controlmm.motion.skeleton import HUMANML3D
from controlmm.ops import recover_joints

SAME_LOSS = 1e-5  # relative: float32 sums in another order
FRAMES = 12
FEET = (7, 10, 8, 11)


@pytest.fixture
def scene(tiny_tlcontrol):
    """Decoder, latents, and targets near the motion: no coordinate is off by more than 1 m."""
    decoder, generator = tiny_tlcontrol.decoder, torch.Generator().manual_seed(4)
    latents = torch.randn(2, 3, 24, generator=generator)
    joints = decoder(latents)
    targets = joints + 0.2 * torch.randn(joints.shape, generator=generator)
    mask = torch.rand(joints.shape, generator=generator) < 0.1
    return decoder, latents, joints, targets, mask, torch.ones(2, FRAMES, dtype=torch.bool)


def losses_by_hand(form, joints, targets, mask) -> list[float]:
    values = []
    for x, y, m in zip(joints.numpy(), targets.numpy(), mask.numpy(), strict=True):
        d = (x - y)[m].astype(np.float64)
        if form == "norm_sum":
            values.append(np.sqrt((((x - y) * m) ** 2).sum(-1)).sum())
        elif form == "smooth_l1":
            values.append(np.where(abs(d) < 1, 0.5 * d**2, abs(d) - 0.5).mean())
        else:
            values.append((0.5 * d**2).mean())
    return values


@pytest.mark.parametrize("form", LOSS_FORMS)
def test_forms_have_the_values_of_their_formulas(scene, form):
    decoder, latents, joints, targets, mask, frames = scene
    loss, _ = trajectory_objective(form, decoder, targets, mask, frames).value_and_gradient(latents)
    expected = torch.tensor(losses_by_hand(form, joints, targets, mask), dtype=torch.float32)
    torch.testing.assert_close(loss, expected, rtol=10 * SAME_LOSS, atol=0)


@pytest.mark.parametrize("form", LOSS_FORMS)
def test_gradients_are_those_of_autograd_through_the_whole_decoder(scene, form):
    decoder, latents, _, targets, mask, frames = scene
    terms = [PublishedFootTerm(frames, HUMANML3D, weight=0.3)]
    objective = trajectory_objective(form, decoder, targets, mask, frames, terms=terms)
    _, gradient = objective.value_and_gradient(latents)
    leaf = latents.clone().requires_grad_()
    joints = recover_joints(decoder.features(leaf), joints=22, backend="reference")
    difference = (joints - targets) * mask
    counts = mask.flatten(1).sum(1)
    if form == "norm_sum":
        squares = difference.square().sum(-1)
        loss = squares.where(squares > 0, 1.0).sqrt().where(squares > 0, 0.0).sum((1, 2))
    else:
        loss = 0.5 * difference.square().sum((1, 2, 3)) / counts
    factor = 0.5 if form == "half_square" else 1.0
    total = loss + factor * terms[0].values(joints)
    (expected,) = torch.autograd.grad(total.sum(), leaf)
    torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=1e-5 * expected.abs().max().item())


def test_smooth_l1_is_linear_beyond_a_metre(scene):
    decoder, latents, joints, targets, mask, frames = scene
    far = torch.where(mask, joints + 3.0, targets)
    loss, _ = trajectory_objective("smooth_l1", decoder, far, mask, frames).value_and_gradient(latents)
    torch.testing.assert_close(loss, torch.full((2,), 2.5), rtol=1e-4, atol=0)


@pytest.mark.parametrize("form", LOSS_FORMS)
def test_selected_clips_keep_their_loss(scene, form):
    decoder, latents, _, targets, mask, frames = scene
    terms = [ContactTerm.of_motion(decoder, latents, frames, mask)]
    objective = trajectory_objective(form, decoder, targets, mask, frames, terms=terms)
    loss, gradient = objective.value_and_gradient(latents)
    rows = torch.tensor([1])
    alone, slope = objective.select(rows).value_and_gradient(latents[rows])
    torch.testing.assert_close(alone, loss[rows], rtol=SAME_LOSS, atol=0)
    torch.testing.assert_close(slope, gradient[rows], rtol=1e-3, atol=1e-4 * gradient.abs().max().item())


def test_an_unknown_form_is_named(scene):
    decoder, _, _, targets, mask, frames = scene
    with pytest.raises(ValueError, match="`form` must be one of half_square, smooth_l1, norm_sum, got 'l3'"):
        trajectory_objective("l3", decoder, targets, mask, frames)


class Square:
    """Sum of squares of the latents."""

    def value_and_gradient(self, latents):
        return latents.square().sum((1, 2)), 2 * latents

    def select(self, clips):
        return self


def test_another_unit_of_the_latents_changes_the_gradient_and_not_the_loss():
    latents = torch.full((1, 2, 3), 4.0)
    loss, gradient = Rescaled(Square(), loss_factor=0.5, unit=10.0).value_and_gradient(latents / 10)
    assert loss.item() == pytest.approx(0.5 * 6 * 16)
    assert torch.equal(gradient, torch.full((1, 2, 3), 0.5 * 10 * 2 * 4.0))


def feet_on_the_floor() -> torch.Tensor:
    """(1, 5, 22, 3): everything at rest, a metre up, but the left foot, which is on the floor."""
    joints = torch.ones(1, 5, 22, 3)
    joints[..., list(HUMANML3D.left_foot), 1] = 0.0
    return joints


def test_resting_feet_cost_their_horizontal_steps():
    joints = feet_on_the_floor()
    joints[0, 3:, 7, 0] += 0.03  # one step of 3 cm between frames 2 and 3, and 4 cm
    joints[0, 3:, 7, 2] += 0.04
    joints[0, 4, 7, 1] += 0.5  # heights are free
    rests = torch.zeros(1, 5, 4, dtype=torch.bool)
    rests[0, 1:3, 0] = True  # the ankle, from frame 1 to 2 and from 2 to 3
    value = ContactTerm(rests, FEET, weight=3.0).values(joints)
    assert value.item() == pytest.approx(3.0 * 0.5 * 0.05**2 / 2, rel=1e-4)
    assert ContactTerm(torch.zeros_like(rests), FEET).values(joints).item() == 0


def test_contacts_come_from_the_motion_and_leave_out_padding_and_targeted_feet(tiny_tlcontrol):
    decoder = tiny_tlcontrol.decoder
    decoder.normalizer.mean[259:] = 1.0  # every foot rests
    decoder.normalizer.std[259:] = 1e-3
    frames = torch.ones(2, FRAMES, dtype=torch.bool)
    frames[1, 8:] = False
    mask = torch.zeros(2, FRAMES, 22, 3, dtype=torch.bool)
    mask[0, 5, 10, 1] = True  # left toe, so that the left foot is targeted in frame 5
    rests = ContactTerm.of_motion(decoder, torch.zeros(2, 3, 24), frames, mask).rests
    assert rests[0, :, 2:].sum(0).tolist() == [11, 11]
    assert (~rests[0, :11, :2]).nonzero()[:, 0].unique().tolist() == [4, 5]
    assert rests[1].sum(0).tolist() == [7, 7, 7, 7]


def test_the_published_foot_term_holds_a_low_foot_where_it_was_last_in_the_air():
    joints = feet_on_the_floor()
    joints[0, 1, [7, 10], 1] = 0.4  # in the air in frame 1
    joints[0, 2:, 7, 0] += 0.2  # the ankle then slides by 20 cm, and stands 3 cm high
    joints[0, 2:, 7, 1] = 0.03
    frames = torch.ones(1, 5, dtype=torch.bool)
    value = PublishedFootTerm(frames, HUMANML3D).values(joints)
    # Frames 2 to 4: mean height 1.5 cm. Four joints of three coordinates a frame.
    expected = 3 * (0.5 * 0.2**2 + 0.5 * 0.03**2) / (4 * 3) / 5
    assert value.item() == pytest.approx(expected, rel=1e-4)


def test_the_published_foot_term_ignores_feet_that_stand_as_people_do():
    joints = feet_on_the_floor()
    joints[..., [7, 8], 1] = 0.08  # an ankle is some centimetres high
    joints[..., [10, 11], 1] = 0.02
    joints[0, :, 7, 0] += torch.arange(5.0)
    assert PublishedFootTerm(torch.ones(1, 5, dtype=torch.bool), HUMANML3D).values(joints).item() == 0


def test_frames_behind_a_clip_do_not_count_in_the_published_foot_term():
    joints = feet_on_the_floor()
    joints[0, 3:, 7, 0] += 0.2
    frames = torch.tensor([[True, True, True, False, False]])
    assert PublishedFootTerm(frames, HUMANML3D).values(joints).item() == 0
