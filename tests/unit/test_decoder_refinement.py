"""What the decoder's refinement measures on joints, by hand."""

import pytest
import torch

from controlmm.data.clip import FeatureClip
from controlmm.models.rvq_vae import RvqVae, RvqVaeConfig
from controlmm.motion.normalizer import Normalizer
from controlmm.training.decoder_refinement import DecoderOptions, DecoderRecipe

_FRAMES = 12


@pytest.fixture(scope="module")
def recipe():
    torch.manual_seed(0)
    clip = FeatureClip("a", torch.randn(_FRAMES, 263), ())
    normalizer = Normalizer.fit([clip.features])
    return DecoderRecipe(
        RvqVae(RvqVaeConfig.tiny()), normalizer, [clip], [clip], stage="rvq-decoder", progress=False
    )


def _losses(recipe, change):
    """Losses of joints that ``change`` moved, in the first 8 of 12 frames; the rest is padding."""
    torch.manual_seed(1)
    wanted = torch.randn(1, _FRAMES, 22, 3)
    frames = torch.arange(_FRAMES)[None] < 8
    shown = wanted.clone()
    change(shown)
    shown[:, 8:] += 100
    return {name: float(value) for name, value in recipe._joint_losses(shown, wanted, frames).items()}


def test_a_body_that_is_moved_as_a_whole_keeps_velocities_and_bones(recipe):
    losses = _losses(recipe, lambda joints: joints[..., 0].add_(0.5))
    assert losses["joint"] == pytest.approx(0.5, abs=1e-5)
    assert losses["velocity"] == pytest.approx(0, abs=1e-4)
    assert losses["bone"] == pytest.approx(0, abs=1e-5)


def test_a_body_that_jitters_has_the_velocity_of_its_jitter(recipe):
    def jitter(joints):
        joints[:, ::2, :, 1] += 0.01

    losses = _losses(recipe, jitter)
    assert losses["joint"] == pytest.approx(0.005, abs=1e-5)  # every other frame is 1 cm off
    assert losses["velocity"] == pytest.approx(0.01 * 20, abs=1e-4)  # 1 cm between any two frames


def test_a_pop_in_the_last_frame_counts_as_acceleration(recipe):
    losses = _losses(recipe, lambda joints: joints[:, 7, :, 1].add_(0.02))
    assert losses["acceleration"] == pytest.approx(0.02 * 20**2 / 6, rel=1e-4)  # one of six differences


def test_a_body_of_twice_the_size_has_bones_that_are_too_long(recipe):
    torch.manual_seed(1)
    wanted = torch.randn(1, _FRAMES, 22, 3)
    parents = list(recipe.normalizer.skeleton.parents[1:])
    lengths = (wanted[0, :8, 1:] - wanted[0, :8, parents]).norm(dim=-1)
    losses = _losses(recipe, lambda joints: joints.mul_(2))
    assert losses["bone"] == pytest.approx(float(lengths.mean()), rel=1e-5)


def test_weights_must_not_be_negative():
    with pytest.raises(ValueError, match="`bone_weight` must not be negative, got -1"):
        DecoderOptions(bone_weight=-1)
