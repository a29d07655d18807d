"""TLControl on a motion that exists: what stays, where it stands, what is refused."""

from __future__ import annotations

import pytest
import torch

from controlmm.controls import JointControl
from controlmm.motion.motion import Motion
from controlmm.pipelines import TLControlPreset
from controlmm.pipelines.source_motion import SourceMotion

QUICK = TLControlPreset(iterations=3)
UNEDITED = TLControlPreset(iterations=0)
EDITED = TLControlPreset(tolerance=1e-7, iterations=60, foot="none")


@pytest.fixture
def source(walk) -> Motion:
    """A walk that stands somewhere in the world and faces somewhere."""
    return Motion(walk(41, turn=0.6, heading=0.9).float() + torch.tensor([2.0, 0.3, -5.0]))


def source_features(source: Motion) -> torch.Tensor:
    return SourceMotion.of(source, skeleton=source.skeleton, max_frames=196).features.float()


def test_kept_tokens_have_the_motions_own_codes_and_the_others_do_not(tiny_tlcontrol, source):
    result = tiny_tlcontrol.edit(source, "a person jumps", keep=[(0, 1)], preset=UNEDITED, samples=2)
    features = tiny_tlcontrol.decoder.normalizer.normalize(source_features(source))
    padded = torch.cat([features, features[-1:].expand(3, -1)])
    tokenizer = tiny_tlcontrol.tokenizer
    own = tokenizer.quantizer.lookup(tokenizer.encode(padded[None]))[0]
    kept = 5  # frames 0 to 20 hold five whole tokens
    assert torch.equal(result.latents[:, :kept], own[:kept].expand(2, -1, -1))
    assert (result.latents[:, kept:] != own[kept:]).flatten(1).any(1).all()


def test_what_is_kept_is_optimised_onto_the_source_in_its_world(tiny_tlcontrol, source):
    errors = [
        tiny_tlcontrol.edit(source, "a person jumps", keep=[(0, 0.5), (1.5, 2.05)], preset=preset)
        for preset in (UNEDITED, EDITED)
    ]
    before, after = (result.control_error[0] for result in errors)
    assert after < 0.5 * before
    frames = [*range(10), *range(30, 41)]
    distance = (errors[1].best.joints[frames] - source.joints[frames]).norm(dim=-1).mean()
    torch.testing.assert_close(distance, after, rtol=0.01, atol=1e-4)


def test_parts_and_controls_are_targets_together(tiny_tlcontrol, source):
    frames = range(41)
    wrist = source.joints[:, 21] + torch.tensor([0.05, 0.1, 0.0])
    control = JointControl("right_wrist", frames=frames, positions=wrist.tolist())
    wanted = source.joints.clone()
    wanted[:, 21] = wrist
    errors = []
    for preset in (UNEDITED, EDITED):
        result = tiny_tlcontrol.edit(
            source, "a person waves", keep_parts=["lower"], controls=[control], preset=preset
        )
        distance = (result.best.joints - wanted).norm(dim=-1)
        errors.append(distance[:, [0, 10, 11, 21]].mean())  # the lower part: pelvis and feet
        assert result.best.extra["mask"].any(0).any(-1).nonzero()[:, 0].tolist() == [0, 10, 11, 21]
    assert errors[1] < 0.5 * errors[0]


def test_the_same_seed_gives_the_same_edit(tiny_tlcontrol, source):
    first, again, other = (
        tiny_tlcontrol.edit(source, "a person jumps", keep=[(0, 1)], preset=QUICK, seed=seed).best.joints
        for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "`keep` or `keep_parts` must name what stays: TLControl predicts all codes at once"),
        ({"keep": [(0, 1)], "samples": 0}, "`samples` must be"),
        ({"keep": [(0, 9)]}, r"`keep\[0\]` must lie within the motion"),
    ],
)
def test_refusals(tiny_tlcontrol, source, options, message, monkeypatch):
    monkeypatch.setattr(type(tiny_tlcontrol.transformer), "forward", None)  # nothing may run
    with pytest.raises(ValueError, match=message):
        tiny_tlcontrol.edit(source, "a person jumps", **options)
