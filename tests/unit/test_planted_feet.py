"""Feet of motions without targets: what the decoder says of their steps, and latents that follow it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.planted_feet import FootStepTerm, with_planted_feet
from controlmm.models.rvq_vae import frame_mask
from controlmm.motion.features import joints_to_features
from controlmm.motion.layout import feature_layout
from controlmm.motion.normalizer import Normalizer
from controlmm.motion.skeleton import HUMANML3D
from controlmm.ops import recover_joints
from controlmm.pipelines import PRESETS

STEP = 1e-5  # metres: float32 features whose steps add up along a clip
FEET = list(HUMANML3D.foot_joints)
ROOT = len(FEET)  # its column of a term
FOOT_WEIGHT, ROOT_WEIGHT = 15.0, 400.0  # for each m^2


class Recording(MotionDecoder):
    """Decodes every latent to a recorded clip."""

    def __init__(self, features: torch.Tensor, tokenizer) -> None:
        super().__init__(tokenizer, Normalizer(torch.zeros(263), torch.ones(263)))
        self.recorded = features

    def clip_features(self, latents, frames=None):
        return self.recorded.expand(len(latents), -1, -1)


@pytest.fixture
def turning(walk, tiny_pipeline) -> Recording:
    """A walk that turns by more than a right angle, so that headings matter; feet near the ground."""
    features = joints_to_features(walk(41, turn=2.0), public_quirks=False)[None]
    return Recording(features, tiny_pipeline.tokenizer)


def term_of(decoder: Recording) -> FootStepTerm:
    frames = torch.ones(1, decoder.recorded.shape[1], dtype=torch.bool)
    return FootStepTerm.of_motion(decoder, torch.zeros(1, 10, 16), frames)


def test_velocities_and_positions_of_a_recording_agree(turning):
    """The velocity channels, turned back into the world, are the steps of the joints."""
    turning.recorded[..., feature_layout(HUMANML3D).foot_contacts] = 0
    joints = recover_joints(turning.recorded, joints=22)
    term = term_of(turning)
    steps = joints[:, :, [*FEET, 0]][..., [0, 2]].diff(dim=1)
    assert steps.abs().max() > 0.02
    torch.testing.assert_close(term.steps, steps, rtol=0, atol=STEP)
    assert term.values(joints).item() < FOOT_WEIGHT * STEP**2 * steps.numel()


def test_feet_at_rest_should_not_step_and_feet_in_the_air_may(turning):
    layout = feature_layout(HUMANML3D)
    joints = recover_joints(turning.recorded, joints=22)
    turning.recorded[..., layout.foot_contacts] = 0
    turning.recorded[:, 10:13, layout.foot_contacts.start + 1] = 1  # left toe, frames 10 to 12: two steps
    term = term_of(turning)
    assert not term.steps[0, 10:12, 1].any()
    assert term.steps[0, 12, 1].any()
    expected = joints[0, 10:13, FEET[1]][:, [0, 2]].diff(dim=0).square().sum()
    assert term.values(joints).item() == pytest.approx(FOOT_WEIGHT * expected.item(), abs=1e-7)
    height = joints[0, :, FEET, 1]
    high = torch.maximum(height[:-1], height[1:]) >= 0.12
    rests = torch.zeros_like(high)
    rests[10:12, 1] = True
    assert torch.equal(term.weights[0, :, :ROOT], FOOT_WEIGHT * (~high | rests))


def test_a_root_that_lags_behind_costs(turning):
    """Or else feet would be planted by a body that goes more slowly."""
    joints = recover_joints(turning.recorded, joints=22)
    term = term_of(turning)
    slower = joints.clone()
    slower[:, :, 0, [0, 2]] *= 0.9
    missing = 0.1 * joints[0, :, 0][:, [0, 2]].diff(dim=0)
    cost = term.values(slower) - term.values(joints)
    assert cost.item() == pytest.approx(ROOT_WEIGHT * missing.square().sum().item(), rel=1e-3)


def test_padding_counts_nothing(turning):
    frames = torch.ones(1, 40, dtype=torch.bool)
    frames[:, 20:] = False
    term = FootStepTerm.of_motion(turning, torch.zeros(1, 10, 16), frames)
    assert term.weights[:, :19, :ROOT].any()
    assert not term.weights[:, 19:].any()


def test_latents_move_until_feet_do_as_the_decoder_says(tiny_pipeline):
    decoder = tiny_pipeline.decoder
    generator = torch.Generator().manual_seed(7)
    latents = decoder.tokenizer.quantizer.lookup(torch.randint(32, (2, 8, 3), generator=generator))
    valid = frame_mask(torch.tensor([8, 5]), 8)
    latents = latents * valid[..., None]
    frames = valid.repeat_interleave(4, dim=1)
    term = FootStepTerm.of_motion(decoder, latents, frames)
    settled = with_planted_feet(decoder, latents, valid)
    before, after = (term.values(decoder(x, frames)) for x in (latents, settled))
    assert (after < 0.8 * before).all()
    assert torch.equal(settled[1, 5:], latents[1, 5:])
    alone = with_planted_feet(decoder, latents[1:, :5], valid[1:, :5])
    assert torch.equal(settled[1:, :5], alone)
    assert torch.equal(with_planted_feet(decoder, latents, valid, strength=0.0), latents)


def test_motions_from_text_have_planted_feet_unless_naturalness_is_off(tiny_pipeline):
    plain, settled = (
        tiny_pipeline("walks", frames=24, preset="fast", naturalness=naturalness) for naturalness in (0, 1)
    )
    assert not torch.equal(plain.best.joints, settled.best.joints)
    budget = replace(PRESETS["fast"].budget, naturalness=0.0)
    published = tiny_pipeline("walks", frames=24, preset=replace(PRESETS["fast"], budget=budget))
    assert torch.equal(plain.best.joints, published.best.joints)
