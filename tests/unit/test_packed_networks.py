"""Packed copies: the same numbers as the plain networks, and the same bits in every company."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from controlmm.generation import frozen_matrix
from controlmm.generation.frozen_matrix import FrozenMatrix, has_fast_bfloat16
from controlmm.generation.noise import clip_seeds
from controlmm.generation.packed_networks import PackedCopies, PackedLinear, packed_copy
from controlmm.models.control_branch import ControlBranch, ControlBranchConfig
from controlmm.models.masked_transformer import MaskedTransformer, MaskedTransformerConfig
from controlmm.models.residual_control import ResidualControl, ResidualControlConfig
from controlmm.models.residual_transformer import ResidualTransformer, ResidualTransformerConfig
from controlmm.nn.conv import ConvEncoder
from controlmm.nn.trunk import encoder_layers
from controlmm.pipelines import PRESETS

ROUNDING = 2e-5  # float32 sums in another order, through a few layers of values of order 1
# bfloat16 has 8 bits, so a product errs by 2^-9 of its terms; normalisation between layers keeps values of
# order 1, and a handful of layers add their errors up.
COARSE = 0.05
DTYPES = [torch.float32, torch.bfloat16]


@pytest.fixture(params=["oneDNN", "MKL"], autouse=True)
def products(request, monkeypatch):
    """Both kinds of products, whichever is the better one here."""
    is_plain = request.param == "MKL"
    if is_plain and not frozen_matrix.plain_products_are_best(64, 64):
        pytest.skip("MKL's products are for processors with AVX2 and nothing wider")
    monkeypatch.setattr(frozen_matrix, "plain_products_are_best", lambda outputs, inputs: is_plain)


def random_(module: nn.Module) -> nn.Module:
    """``module`` with weights of a size at which every one of them counts."""
    generator = torch.Generator().manual_seed(0)
    for parameter in module.parameters():
        if parameter.ndim > 1:
            scale = parameter[0].numel() ** -0.5
            parameter.data.copy_(torch.randn(parameter.shape, generator=generator) * scale)
    return module.eval().requires_grad_(False)


def values(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(1))


def tolerance(dtype: torch.dtype) -> float:
    return ROUNDING if dtype == torch.float32 else COARSE


@pytest.fixture(scope="module")
def transformer() -> MaskedTransformer:
    """Wide enough for every path of the products."""
    config = replace(MaskedTransformerConfig.tiny(), width=64, feedforward=320, layers=3)
    return random_(MaskedTransformer(config))


def called(network: MaskedTransformer, embedded: torch.Tensor, valid: torch.Tensor | None = None):
    text = values(len(embedded), 64)
    return network(embedded, text, torch.ones(embedded.shape[:2]).bool() if valid is None else valid)


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_masked_transformer_says_the_same(transformer, dtype):
    embedded = values(3, 7, 16)
    packed = packed_copy(transformer, dtype)
    assert isinstance(packed, MaskedTransformer)
    logits = called(packed, embedded)
    assert logits.dtype == torch.float32
    torch.testing.assert_close(logits, called(transformer, embedded), rtol=0, atol=tolerance(dtype))


@pytest.mark.parametrize("dtype", DTYPES)
def test_padding_is_not_seen(transformer, dtype):
    embedded, valid = values(3, 7, 16), torch.ones(3, 7).bool()
    valid[1, 4:] = valid[2, 2:] = False
    expected = called(transformer, embedded, valid)
    logits = called(packed_copy(transformer, dtype), embedded, valid)
    torch.testing.assert_close(logits[valid], expected[valid], rtol=0, atol=tolerance(dtype))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("encoder", ["convolution", "projection"])
def test_a_control_branch_says_the_same(transformer, dtype, encoder):
    config = replace(
        ControlBranchConfig.tiny(), width=64, feedforward=320, layers=3, encoder=encoder, encoder_depth=2
    )
    branch = random_(ControlBranch(config))
    sequence, valid = transformer.sequence(values(2, 7, 16), values(2, 64)), torch.ones(2, 7).bool()
    valid[1, 5:] = False
    signal = values(2, 28, config.signal_dim) * valid.repeat_interleave(4, dim=1)[..., None]
    expected = branch(transformer, sequence, signal, valid)
    packed = packed_copy(branch, dtype)(packed_copy(transformer, dtype), sequence, signal, valid)
    torch.testing.assert_close(packed[valid], expected[valid], rtol=0, atol=2 * tolerance(dtype))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shares_tables", [True, False])
def test_residual_layers_and_their_control_say_the_same(dtype, shares_tables):
    config = replace(ResidualTransformerConfig.tiny(), shares_tables=shares_tables)
    residual = random_(ResidualTransformer(config))
    control = random_(ResidualControl(ResidualControlConfig.tiny()))
    history, valid, text = values(2, 5, 16), torch.ones(2, 5).bool(), values(2, 64)
    signal = values(2, 20, 198)
    for layers in (torch.tensor([1, 1]), torch.tensor([2, 1])):
        expected = residual(history, layers, text, valid, control(signal, layers, valid))
        hints = packed_copy(control, dtype)(signal, layers, valid)
        logits = packed_copy(residual, dtype)(history, layers, text, valid, hints)
        torch.testing.assert_close(logits, expected, rtol=0, atol=2 * tolerance(dtype))


def test_layers_with_a_rectifier_say_the_same():
    layers = random_(encoder_layers(2, width=16, heads=2, feedforward=32, dropout=0.1, activation="relu"))
    hidden, padding = values(2, 5, 16), torch.zeros(2, 5).bool()
    for layer, packed in zip(layers, packed_copy(layers, torch.float32), strict=True):
        expected = layer(hidden, src_key_padding_mask=padding)
        torch.testing.assert_close(packed(hidden, padding), expected, rtol=0, atol=ROUNDING)


def test_the_head_stays_in_float32(transformer):
    hidden = values(4, 64)
    coarse, fine = (packed_copy(transformer, dtype).head(hidden) for dtype in (torch.bfloat16, torch.float32))
    assert torch.equal(coarse, fine)


def test_wide_products_in_bfloat16_are_sums_of_narrow_ones():
    """Compared in float64 on the rounded factors: what is left is the rounding of three results."""
    weight, x = values(40, 600), values(50, 600)
    rounded = [tensor.bfloat16().double() for tensor in (x, weight)]
    product = FrozenMatrix(weight, None, torch.bfloat16)(x.bfloat16())
    expected = rounded[0] @ rounded[1].T
    assert (product.double() - expected).abs().max() < 3 * 2**-8 * expected.abs().max()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(("width", "feedforward"), [(64, 320), (256, 512)])
def test_a_clip_has_the_same_bits_in_every_batch(dtype, threads, width, feedforward):
    """Widths at which oneDNN's bfloat16 products used to depend on the number of rows."""
    if dtype == torch.bfloat16 and not has_fast_bfloat16():
        pytest.skip("bfloat16 is for processors with AMX")
    config = replace(MaskedTransformerConfig.tiny(), width=width, feedforward=feedforward, heads=4)
    packed = packed_copy(random_(MaskedTransformer(config)), dtype)
    embedded, text = values(24, 49, 16), values(24, 64)
    before = torch.get_num_threads()
    together = {
        length: packed(embedded[:, :length], text, torch.ones(24, length).bool()) for length in (49, 20, 2)
    }
    torch.set_num_threads(threads)
    try:
        for length, expected in together.items():
            for count in (1, 2, 3, 5, 8, 16):
                logits = packed(embedded[:count, :length], text[:count], torch.ones(count, length).bool())
                assert torch.equal(logits, expected[:count])
        clips, tokens = [3, 0, 5, 1, 2, 4], torch.tensor([49, 2, 20, 49, 20, 2])
        valid = torch.arange(49) < tokens[:, None]
        padded = packed(embedded[clips], text[clips], valid)
        for logits, clip, length in zip(padded, clips, tokens.tolist(), strict=True):
            assert torch.equal(logits[:length], together[length][clip])
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("is_bfloat16", [False, True])
@pytest.mark.parametrize("threads", [1, 2])
def test_drawn_latents_of_a_clip_do_not_depend_on_batch_padding_or_threads(
    tiny_pipeline, is_bfloat16, threads
):
    """Two clips with targets and two without, of three lengths, through masked and residual transformer."""
    lengths, seeds = [40, 17, 40, 28], clip_seeds(1, 4)
    text = values(4, 64)
    targets = values(4, 40, 22, 3)
    mask = torch.zeros(4, 40, 22, 3).bool()
    mask[0, [5, 39], 21] = mask[1, 16, 0] = True
    budget = replace(PRESETS["fast"].budget, latent_iterations=0, naturalness=0.0)
    plan = replace(PRESETS["fast"], budget=budget, steps=4, is_bfloat16=is_bfloat16)

    def latents(clips: slice, longest: int) -> torch.Tensor:
        return tiny_pipeline.generate_latents(
            text[clips],
            lengths=lengths[clips],
            targets=targets[clips, :longest],
            mask=mask[clips, :longest],
            seeds=seeds[clips],
            preset=plan,
        )

    together = latents(slice(None), 40)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        for clip, length in enumerate(lengths):
            alone = latents(slice(clip, clip + 1), length)
            assert torch.equal(alone[0], together[clip, : alone.shape[1]])
            assert not together[clip, alone.shape[1] :].any()
    finally:
        torch.set_num_threads(before)


def test_copies_are_made_once_and_anew_when_weights_change(transformer):
    copies, linear = PackedCopies(), nn.Linear(4, 4)
    holder = nn.Sequential(linear)
    first = copies.of(holder, torch.float32)
    assert copies.of(holder, torch.float32) is first
    assert copies.of(holder, torch.bfloat16) is not first
    assert isinstance(first[0], PackedLinear)
    with torch.no_grad():
        linear.weight.mul_(2)
    again = copies.of(holder, torch.float32)
    torch.testing.assert_close(again(values(3, 4)), holder(values(3, 4)))
    assert isinstance(holder[0], nn.Linear)  # what is trained and saved stays as it is


def test_an_encoder_with_strides_and_dilations_says_the_same():
    encoder = random_(ConvEncoder(5, 6, width=8, depth=3, downsample=4, dropout=0.1))
    frames = torch.arange(24) < torch.tensor([[24], [16]])
    x = values(2, 5, 24)
    packed = packed_copy(encoder, torch.float32)
    torch.testing.assert_close(packed(x, frames), encoder(x, frames), rtol=0, atol=ROUNDING)


def test_bfloat16_can_be_switched_off(monkeypatch):
    monkeypatch.setenv("CONTROLMM_BFLOAT16", "0")
    assert not has_fast_bfloat16()


def test_only_our_presets_and_models_multiply_in_bfloat16(tiny_pipeline, monkeypatch):
    from controlmm.pipelines import controlmm as module

    monkeypatch.setattr(module, "has_fast_bfloat16", lambda: True)
    for name, preset in PRESETS.items():
        expected = torch.float32 if name.startswith("paper") else torch.bfloat16
        assert tiny_pipeline.drawing_dtype(preset) == expected
    published = replace(tiny_pipeline.control.config, has_observation_mask=False)
    monkeypatch.setattr(tiny_pipeline.control, "config", published)
    assert tiny_pipeline.drawing_dtype(PRESETS["accurate"]) == torch.float32
