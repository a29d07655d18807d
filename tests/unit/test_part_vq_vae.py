"""The part-based tokenizer: published sizes, parts apart, scaling of latents, padding, codebooks."""

from __future__ import annotations

import pytest
import torch

from controlmm.models.part_vq_vae import PartVqVae, PartVqVaeConfig
from controlmm.models.rvq_vae import frame_mask
from controlmm.motion.body_parts import body_parts
from controlmm.motion.skeleton import HUMANML3D
from controlmm.nn.part_quantizer import PartQuantizer

SAME_CLIP = 1e-5  # float32 sums over another batch size and length


@pytest.fixture
def tokenizer() -> PartVqVae:
    torch.manual_seed(0)
    model = PartVqVae(PartVqVaeConfig.tiny()).eval()
    for part in range(model.config.num_parts):
        model.quantizer.book(part).codes.normal_()
    return model


def some_features(frames: int = 24, batch: int = 2) -> torch.Tensor:
    return torch.randn(batch, frames, 263, generator=torch.Generator().manual_seed(1))


def test_the_paper_configuration_has_the_published_sizes():
    with torch.device("meta"):
        model = PartVqVae(PartVqVaeConfig.paper())
    encoders, decoder = (sum(p.numel() for p in x.parameters()) for x in (model.encoders, model.decoder))
    assert (round(encoders / 1e6, 2), round(decoder / 1e6, 2)) == (51.96, 10.24)
    assert model.config.latent_dim == 768


def test_codes_of_a_part_come_from_its_own_channels(tokenizer):
    features = some_features()
    before = tokenizer.encode_latents(features)
    for index, part in enumerate(body_parts(HUMANML3D)):
        changed = features.clone()
        changed[..., list(part.channels)] += 1.0
        difference = (tokenizer.encode_latents(changed) - before).abs().amax((0, 1)).unflatten(0, (6, 4))
        assert difference[index].max() > 1e-3
        assert difference[[other for other in range(6) if other != index]].max() == 0


def test_step_norm_makes_every_token_of_every_part_a_unit_of_root_mean_square(tokenizer):
    latents = tokenizer.encode_latents(some_features()).unflatten(-1, (6, 4))
    torch.testing.assert_close(latents.square().mean(-1), torch.ones(2, 6, 6), rtol=0, atol=1e-5)


def test_clip_norm_is_the_published_frobenius_norm_over_channels_and_time():
    torch.manual_seed(0)
    config = PartVqVaeConfig.tiny()
    model = PartVqVae(type(config)(**{**vars(config), "latent_norm": "clip"})).eval()
    latents = model.encode_latents(some_features()).unflatten(-1, (6, 4))
    torch.testing.assert_close(latents.square().sum((1, 3)), torch.ones(2, 6), rtol=0, atol=1e-5)


@pytest.mark.parametrize("norm", ["clip", "step"])
def test_a_latent_of_zeros_stays_finite(norm):
    config = PartVqVaeConfig.tiny()
    model = PartVqVae(type(config)(**{**vars(config), "latent_norm": norm}))
    for parameter in model.encoders.parameters():
        torch.nn.init.zeros_(parameter)
    features = some_features().requires_grad_()
    latents = model.encode_latents(features)
    latents.sum().backward()
    assert latents.abs().max() == 0
    assert torch.isfinite(features.grad).all()


def test_a_short_clip_in_a_padded_batch_is_tokenised_as_alone(tokenizer):
    features, frames = some_features(40), frame_mask(torch.tensor([40, 12]), 40)
    ids = tokenizer.encode(features, frames)
    assert torch.equal(ids[1:, :3], tokenizer.encode(features[1:, :12]))
    assert (ids[1, 3:] == -1).all()
    decoded = tokenizer.decode_ids(ids, frames)
    torch.testing.assert_close(decoded[1:, :12], tokenizer.decode_ids(ids[1:, :3]), rtol=0, atol=SAME_CLIP)


def test_codes_are_the_nearest_of_each_parts_book(tokenizer):
    features = some_features()
    latents = tokenizer.encode_latents(features).unflatten(-1, (6, 4))
    ids = tokenizer.encode(features)
    for part in range(6):
        distance = torch.cdist(latents[:, :, part], tokenizer.quantizer.book(part).codes)
        assert torch.equal(ids[..., part], distance.argmin(-1))
    looked_up = tokenizer.quantizer.lookup(ids).unflatten(-1, (6, 4))
    assert torch.equal(looked_up[0, 2, 3], tokenizer.quantizer.book(3).codes[ids[0, 2, 3]])


def test_codebooks_follow_their_part_and_are_saved(tokenizer, tmp_path):
    model = tokenizer.train()
    for part in range(6):
        model.quantizer.book(part).is_initialized.fill_(False)
    model(some_features(64, batch=8))
    assert all(model.quantizer.book(part).is_initialized for part in range(6))
    names = [name for name in model.state_dict() if name.endswith("ema_sum")]
    assert len(names) == 6
    model.save_pretrained(tmp_path)
    loaded = PartVqVae.from_pretrained(tmp_path)
    assert torch.equal(loaded.quantizer.book(4).codes, model.quantizer.book(4).codes)


def test_the_gradient_passes_straight_through_the_codes():
    torch.manual_seed(0)
    quantizer = PartQuantizer(parts=2, num_codes=4, dim=3, decay=0.99).eval()
    for part in range(2):
        quantizer.book(part).codes.normal_()
    latents = torch.randn(1, 5, 6, requires_grad=True)
    weights = torch.randn(1, 5, 6)
    (quantizer(latents).latents * weights).sum().backward()
    assert torch.equal(latents.grad, weights)


def test_the_ablation_has_the_same_latents_and_as_many_codes():
    config = PartVqVaeConfig.tiny()
    unsplit = config.unsplit()
    assert unsplit.latent_dim == config.latent_dim
    assert unsplit.num_parts == 1
    assert unsplit.codebook_size == 6 * config.codebook_size
    model = PartVqVae(unsplit).eval()
    assert model.encode(some_features()).shape == (2, 6, 1)
    assert model.decode(model.encode_latents(some_features())).shape == (2, 24, 263)


def test_the_decoder_is_channel_major_for_the_kernels(tokenizer):
    latents = torch.randn(2, 6, 24)
    torch.testing.assert_close(
        tokenizer.decode_channels(latents).transpose(1, 2), tokenizer.decode(latents), rtol=0, atol=0
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"downsample": 3}, "`downsample` must be a power of two and at least 2, got 3"),
        ({"encoder_width": 0}, "Sizes must be positive"),
        ({"latent_norm": "none"}, "`latent_norm` must be 'step' or 'clip', got 'none'"),
    ],
)
def test_impossible_configurations_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        PartVqVaeConfig(**changes)


def test_frames_that_make_no_whole_token_are_refused(tokenizer):
    with pytest.raises(ValueError, match="`features` must have a multiple of 4 frames, got 10"):
        tokenizer.encode(torch.zeros(1, 10, 263))


def test_perplexity_of_an_unused_book_is_one(tokenizer):
    for part in range(6):
        tokenizer.quantizer.book(part).codes.fill_(100.0)
        tokenizer.quantizer.book(part).codes[0] = 0.0
    quantized = tokenizer.quantizer(tokenizer.encode_latents(some_features()))
    assert quantized.perplexity.item() == pytest.approx(1.0, abs=1e-5)
    assert quantized.commitment.item() == pytest.approx(1.0, abs=1e-5)  # mean square of unit latents
