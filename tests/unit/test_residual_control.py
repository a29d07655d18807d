"""Residual layers under control: what the network sees, that it is silent until trained, and its losses."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import one_hot

from controlmm import ControlMM
from controlmm.data import Caption, FeatureClip
from controlmm.evaluation.controlmm_tables import without_control_model
from controlmm.generation.controlled_layers import ControlledLayers, without_base
from controlmm.generation.editing import EditingBudget
from controlmm.generation.kept_tokens import KeptTokens
from controlmm.models.masked_transformer import MaskedTransformer, MaskedTransformerConfig
from controlmm.models.residual_control import ResidualControl, ResidualControlConfig
from controlmm.models.residual_transformer import ResidualTransformer, ResidualTransformerConfig
from controlmm.motion.skeleton import HUMANML3D, KIT
from controlmm.pipelines import PRESETS
from controlmm.training.residual_control import ResidualControlOptions, ResidualControlRecipe
from controlmm.training.tokens import TokenSampler

TURNED = 1e-5  # m and m/s: float32 sines of an angle
SAME_CLIP = 1e-4  # logits of order one, float32 sums over another batch size


@pytest.fixture
def control() -> ResidualControl:
    """With zero linears that have spoken."""
    torch.manual_seed(0)
    network = ResidualControl(ResidualControlConfig.tiny()).eval()
    for zero in network.zeros:
        torch.nn.init.normal_(zero.weight, std=0.3)
    torch.nn.init.normal_(network.factors)
    return network


@pytest.fixture
def controlled(tiny_pipeline, control) -> ControlMM:
    return ControlMM(
        **(tiny_pipeline.networks() | {"residual_control": control}),
        normalizer=tiny_pipeline.decoder.normalizer,
        text_encoder=tiny_pipeline.text_encoder,
    )


def goals(frames: int, clips: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    """Pelvis targets on some frames."""
    targets = torch.randn(clips, frames, 22, 3, generator=torch.Generator().manual_seed(1))
    mask = torch.zeros(clips, frames, 22, 3, dtype=torch.bool)
    mask[:, [3, 9, 14], 0] = True
    return targets, mask


# --- the network ---


def test_a_fresh_one_is_silent_and_each_zero_linear_speaks(tiny_pipeline):
    residual, valid = tiny_pipeline.residual, torch.ones(1, 5, dtype=torch.bool)
    fresh = ResidualControl(ResidualControlConfig.tiny()).eval().requires_grad_(False)
    signal = fresh.signal(*goals(20), torch.randn(1, 20, 22, 3, generator=torch.Generator().manual_seed(3)))
    number, text = torch.tensor([1]), torch.ones(1, 64)
    history = residual.history(torch.zeros(1, 5, 3, dtype=torch.long), number)
    plain = residual(history, number, text, valid)
    assert torch.equal(residual(history, number, text, valid, fresh(signal, number, valid)), plain)
    for zero in fresh.zeros:
        spoken = copy.deepcopy(fresh)
        index = list(fresh.zeros).index(zero)
        torch.nn.init.normal_(spoken.zeros[index].weight)
        changed = residual(history, number, text, valid, spoken(signal, number, valid))
        assert (changed - plain).abs().max() > 1e-4


def test_layers_have_factors_of_their_own(control):
    signal, valid = control.signal(*goals(20), torch.zeros(1, 20, 22, 3)), torch.ones(1, 5, dtype=torch.bool)
    first, second = (control(signal, torch.tensor([layer]), valid) for layer in (1, 2))
    assert all((a - b).abs().max() > 1e-4 for a, b in zip(first, second, strict=True))


def test_padding_and_neighbours_change_nothing(control):
    targets, mask = goals(32, clips=2)
    current = torch.randn(2, 32, 22, 3, generator=torch.Generator().manual_seed(4))
    valid = torch.ones(2, 8, dtype=torch.bool)
    valid[1, 5:] = False
    signal = control.signal(targets, mask, current)
    together = control(signal, torch.tensor([1, 2]), valid)
    alone = control(signal[1:, :20], torch.tensor([2]), valid[1:, :5])
    for a, b in zip(together, alone, strict=True):
        torch.testing.assert_close(a[1:, :5], b, rtol=0, atol=SAME_CLIP)


@pytest.mark.parametrize("size", ["tiny", "small", "paper"])
def test_it_fits_the_residual_transformer_of_its_size(size):
    getattr(ResidualControlConfig, size)().check_base(getattr(ResidualTransformerConfig, size)())


def test_what_does_not_fit_is_refused(tiny_pipeline):
    with pytest.raises(ValueError, match=r"\(16, 2, 3\), but the residual transformer has \(256, 4, 6\)"):
        ResidualControlConfig.tiny().check_base(ResidualTransformerConfig.small())
    with pytest.raises(ValueError, match="`joints` must name at least one joint"):
        replace(ResidualControlConfig.tiny(), joints=())
    parts = {**tiny_pipeline.networks(), "normalizer": tiny_pipeline.decoder.normalizer}
    parts["text_encoder"] = tiny_pipeline.text_encoder
    for change, message in (
        ({"joints": (0, 22)}, "`joints` of `residual_control` must be below 22"),
        ({"downsample": 2}, "`downsample` of `residual_control` must be 4, got 2"),
    ):
        other = ResidualControl(replace(ResidualControlConfig.tiny(), **change))
        with pytest.raises(ValueError, match=message):
            ControlMM(**parts, residual_control=other)


def test_other_skeletons_bring_their_unit_and_rate():
    config = ResidualControlConfig.small().for_skeleton(KIT)
    assert (len(config.joints), config.signal_scale, config.fps) == (21, KIT.metres, KIT.fps)
    assert ResidualControlConfig.paper().for_skeleton(HUMANML3D).joints == HUMANML3D.control_joints


# --- in generation ---


def drawn(pipeline: ControlMM, *, goal: bool = True) -> torch.Tensor:
    targets, mask = goals(24)
    return pipeline.generate_latents(
        pipeline.text_encoder.encode(["walks"]).pooled,
        lengths=[24],
        targets=targets,
        mask=mask & goal,
        seeds=[0],
        preset=replace(PRESETS["fast"], budget=EditingBudget(latent_iterations=0)),
    )


def test_it_changes_motions_that_have_targets_and_no_others(tiny_pipeline, controlled):
    assert not torch.equal(drawn(controlled), drawn(tiny_pipeline))
    assert torch.equal(drawn(controlled, goal=False), drawn(tiny_pipeline, goal=False))
    assert torch.equal(drawn(without_control_model(controlled)), drawn(without_control_model(tiny_pipeline)))


def test_it_is_saved_and_loaded_with_the_pipeline(controlled, tmp_path):
    again = ControlMM.from_pretrained(controlled.save_pretrained(tmp_path / "model"))
    assert torch.equal(drawn(again), drawn(controlled))


def test_kept_tokens_count_with_all_their_layers(controlled):
    """The present motion holds the kept codes, also in layers that are not filled in yet."""
    decoder, valid = controlled.decoder, torch.ones(1, 6, dtype=torch.bool)
    where = torch.tensor([[True, True, False, False, False, False]])
    ids = torch.randint(32, (1, 6, 3), generator=torch.Generator().manual_seed(5))
    targets, mask = goals(24)
    layers = ControlledLayers(
        controlled.residual_control,
        decoder,
        targets,
        mask,
        decoder.tokenizer.quantizer.lookup(ids[..., :1]),
        KeptTokens(ids, where),
    )
    started = torch.cat([ids[..., :1], torch.full((1, 6, 2), -1)], dim=-1)
    whole = torch.where(where[..., None], ids, started)
    plain = replace(layers, kept=None)
    number = torch.tensor([1])
    for a, b in zip(layers.hints(started, number, valid), plain.hints(whole, number, valid), strict=True):
        assert torch.equal(a, b)
    assert without_base(ids)[0, 0].tolist() == [-1, *ids[0, 0, 1:].tolist()]


# --- its training ---


@pytest.fixture
def recipe_of(tiny_pipeline):
    decoder = tiny_pipeline.decoder
    generator = torch.Generator().manual_seed(1)
    clips = [
        FeatureClip(
            f"clip{i}",
            decoder.normalizer.denormalize(torch.randn(48 + 8 * i, 263, generator=generator)),
            (Caption("walks"),),
            "lab",
        )
        for i in range(3)
    ]
    text = {"walks": torch.ones(64)}
    samplers = [
        TokenSampler(clips, decoder.normalizer, decoder.tokenizer, text, progress=False) for _ in range(2)
    ]

    def make(**options):
        torch.manual_seed(3)
        return ResidualControlRecipe(
            ResidualControlConfig.tiny(),
            MaskedTransformer(MaskedTransformerConfig.tiny()),
            ResidualTransformer(ResidualTransformerConfig.tiny()),
            decoder,
            *samplers,
            options=ResidualControlOptions(**options),
        )

    return make


def test_above_a_recorded_base_the_recorded_codes_count_as_natural(recipe_of):
    """Fresh, the cross-entropy is the frozen residual transformer's own; worked out here from its logits."""
    recipe = recipe_of(drawn_share=0.0)
    recipe.model.eval()
    batch = recipe._val.whole([0, 1, 2])
    number = torch.full((3,), 1)
    residual = recipe.residual
    logits = residual(residual.history(batch.ids, number), number, batch.text, batch.valid)[..., :-1]
    wanted = one_hot(batch.ids[..., 1].clamp(min=0), 32)
    expected = -(logits.log_softmax(-1) * wanted).sum(-1)[batch.valid].mean()
    assert recipe._losses(batch, 1)["cross_entropy"].item() == pytest.approx(expected.item(), rel=1e-5)


def test_above_a_drawn_base_natural_is_what_the_residual_transformer_would_do(recipe_of):
    """Fresh, both are equal, so the cross-entropy is the entropy, and its gradient on the hints is zero."""
    recipe = recipe_of(drawn_share=1.0, alpha=1.0)
    recipe.model.eval()
    losses = recipe._losses(recipe._val.whole([0, 1, 2]), 1)
    losses["loss"].backward()
    assert 0 < losses["cross_entropy"].item() <= math.log(32) + 1e-5
    assert max(zero.weight.grad.abs().max() for zero in recipe.model.zeros) < 1e-6


def test_the_consistency_loss_sees_the_codes_that_decoding_takes(recipe_of):
    recipe = recipe_of()
    logits = torch.randn(2, 4, 32, generator=torch.Generator().manual_seed(6)).requires_grad_()
    codes = recipe.decoder.tokenizer.quantizer.book(1).codes
    chosen = recipe._chosen(logits, 1)
    torch.testing.assert_close(chosen, codes[logits.argmax(-1)], rtol=0, atol=1e-6)
    (gradient,) = torch.autograd.grad(chosen[..., 0].sum(), logits)
    (soft,) = torch.autograd.grad((logits.softmax(-1) @ codes)[..., 0].sum(), logits)
    torch.testing.assert_close(gradient, soft)


def test_training_brings_the_joints_nearer(recipe_of):
    recipe = recipe_of(alpha=0.0, masks="trajectory")
    optimizer = torch.optim.Adam(recipe.model.parameters(), lr=3e-3)
    before = recipe.validate()["consistency"]
    recipe.model.train()
    for _ in range(40):
        optimizer.zero_grad()
        recipe.loss(6)["loss"].backward()
        optimizer.step()
    recipe.model.eval()
    torch.manual_seed(0)
    assert recipe.validate()["consistency"] < 0.9 * before
    assert all(parameter.grad is None for parameter in recipe.residual.parameters())


@pytest.mark.parametrize("name", ["alpha", "drawn_share"])
def test_impossible_options_are_refused(name):
    with pytest.raises(ValueError, match=rf"`{name}` must be in \[0, 1\], got 1.5"):
        ResidualControlOptions(**{name: 1.5})
