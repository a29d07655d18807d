"""Convolutional encoder and decoder: sizes, dilations, and masks."""

from __future__ import annotations

import pytest
import torch

from controlmm.models.part_vq_vae import PartVqVaeConfig
from controlmm.models.rvq_vae import RvqVaeConfig
from controlmm.nn.conv import ConvDecoder, ConvEncoder, ResidualStack

SAME_CLIP = 1e-5  # convolutions of another batch size and length sum in another order
SIZES = {"width": 12, "depth": 2, "downsample": 4, "dropout": 0.0}


def prefix(lengths: list[int], frames: int) -> torch.Tensor:
    return torch.arange(frames) < torch.tensor(lengths)[:, None]


@pytest.fixture(params=["zeros", "repeat"])
def networks(request):
    torch.manual_seed(0)
    return ConvEncoder(7, 5, **SIZES), ConvDecoder(5, 7, **SIZES, ends=request.param)


@pytest.mark.parametrize("frames", [4, 8, 40])
def test_four_frames_make_one_token_and_back(networks, frames):
    encoder, decoder = networks
    tokens = encoder(torch.randn(2, 7, frames))
    assert tokens.shape == (2, 5, frames // 4)
    assert decoder(tokens).shape == (2, 7, frames)


def test_dilations_descend():
    assert [block.dilated.dilation for block in ResidualStack(4, depth=3, dropout=0.0)] == [(9,), (3,), (1,)]


@pytest.mark.parametrize("length", [4, 16, 36])
@pytest.mark.parametrize("part", [0, 1], ids=["encoder", "decoder"])
def test_a_short_clip_in_a_padded_batch_equals_the_clip_alone(networks, part, length):
    network, longest, per_token = networks[part], 40, 4
    generator = torch.Generator().manual_seed(length)
    steps = (longest, length) if part == 0 else (longest // per_token, length // per_token)
    batch = torch.randn(2, (7, 5)[part], steps[0], generator=generator)  # padding holds noise, not zeros
    alone = network(batch[1:, :, : steps[1]])
    padded = network(batch, prefix([longest, length], longest))
    torch.testing.assert_close(padded[1:, :, : alone.shape[-1]], alone, rtol=0, atol=SAME_CLIP)
    assert padded[1, :, alone.shape[-1] :].abs().max() == 0


def test_a_full_mask_changes_nothing(networks):
    encoder, _ = networks
    x = torch.randn(2, 7, 16)
    assert torch.equal(encoder(x, prefix([16, 16], 16)), encoder(x))


def test_no_gradient_reaches_padding(networks):
    encoder, decoder = networks
    x = torch.randn(1, 7, 24, requires_grad=True)
    valid = prefix([12], 24)
    (gradient,) = torch.autograd.grad(decoder(encoder(x, valid), valid).square().sum(), x)
    assert gradient[..., 12:].abs().max() == 0
    assert gradient[..., :12].abs().min() > 0


@pytest.mark.parametrize("tokens", [1, 2, 9])
def test_repeated_ends_are_what_the_first_and_the_last_token_once_more_give(tokens):
    torch.manual_seed(0)
    plain = ConvDecoder(5, 7, **SIZES)
    repeating = ConvDecoder(5, 7, **SIZES, ends="repeat")
    repeating.load_state_dict(plain.state_dict())
    x = torch.randn(2, 5, tokens)
    longer = torch.cat([x[..., :1], x, x[..., -1:]], dim=-1)
    assert torch.equal(repeating(x), plain(longer)[..., 4:-4])
    assert not torch.allclose(repeating(x), plain(x))


@pytest.mark.parametrize("config", [RvqVaeConfig, PartVqVaeConfig])
def test_unknown_ends_are_refused(config):
    with pytest.raises(
        ValueError, match=r"`decoder_ends` must be one of \('zeros', 'repeat'\), got 'mirror'"
    ):
        config(decoder_ends="mirror")
