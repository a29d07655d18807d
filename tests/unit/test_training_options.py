"""Where the paper and the published code differ in training: both sides of every option."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from controlmm.data import Caption, FeatureClip
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.token_mixture import token_mixture
from controlmm.models.control_branch import ControlBranchConfig
from controlmm.models.masked_transformer import MaskedTransformer, MaskedTransformerConfig
from controlmm.models.rvq_vae import RvqVae, RvqVaeConfig, frame_mask
from controlmm.motion.normalizer import Normalizer
from controlmm.motion.skeleton import HUMANML3D
from controlmm.ops import masked_consistency_loss, recover_joints
from controlmm.training.control import ControlOptions, ControlRecipe
from controlmm.training.control_masks import sample_masks
from controlmm.training.corruption import corrupt_tokens
from controlmm.training.masked import MaskedOptions, MaskedRecipe, token_cross_entropy
from controlmm.training.rvq import RvqOptions, RvqRecipe
from controlmm.training.soft_tokens import mixed_codes
from controlmm.training.tokens import TokenSampler

EXACT = 1e-6  # float32 rounding of numbers of order one
TEXT = 64


@pytest.fixture(scope="module")
def decoder() -> MotionDecoder:
    torch.manual_seed(0)
    tokenizer = RvqVae(RvqVaeConfig.tiny()).eval()
    for layer in range(tokenizer.config.num_quantizers):
        tokenizer.quantizer.book(layer).codes.normal_()
    return MotionDecoder(tokenizer, Normalizer(torch.zeros(263), torch.full((263,), 0.05)))


@pytest.fixture(scope="module")
def samplers(decoder) -> tuple[TokenSampler, TokenSampler]:
    generator = torch.Generator().manual_seed(1)
    clips = [
        FeatureClip(
            f"clip{i}", 0.05 * torch.randn(48 + 8 * i, 263, generator=generator), (Caption("walks"),), "lab"
        )
        for i in range(3)
    ]
    text = {"walks": torch.ones(TEXT)}
    samplers = [
        TokenSampler(clips, decoder.normalizer, decoder.tokenizer, text, progress=False) for _ in range(2)
    ]
    return samplers[0], samplers[1]


@pytest.fixture
def base() -> MaskedTransformer:
    torch.manual_seed(2)
    network = MaskedTransformer(MaskedTransformerConfig.tiny())
    network.head[-1].weight.data.mul_(30)  # logits that tell codes apart
    network.text_proj.weight.data.mul_(30)
    return network


def control_losses(decoder, samplers, base, *, seed=3, **options):
    """Losses of one training batch; the same draws whatever the options."""
    torch.manual_seed(4)
    recipe = ControlRecipe(
        ControlBranchConfig.tiny(), base, decoder, *samplers, options=ControlOptions(**options)
    )
    recipe.model.train()
    torch.manual_seed(seed)
    return {name: value.item() for name, value in recipe.loss(8).items()}


# --- tokens that the consistency loss decodes (rows 3 and 13) ---


def test_softmax_is_the_mean_code_and_draws_nothing():
    logits, codes = torch.tensor([[[0.0, math.log(3.0)]]]), torch.eye(2)
    state = torch.get_rng_state()
    assert mixed_codes(logits, codes, "softmax")[0, 0].tolist() == pytest.approx([0.25, 0.75])
    assert torch.equal(torch.get_rng_state(), state)


def test_straight_through_gumbel_gives_a_code_with_its_probability_and_the_soft_gradient():
    torch.manual_seed(0)
    count = 4000
    logits = torch.tensor([0.0, math.log(3.0)]).expand(1, count, 2).clone().requires_grad_()
    drawn = mixed_codes(logits, torch.eye(2), "gumbel_st")
    assert set(drawn.detach().flatten().tolist()) == {0.0, 1.0}
    assert drawn[..., 1].mean().item() == pytest.approx(0.75, abs=4.5 * math.sqrt(0.75 * 0.25 / count))
    torch.manual_seed(0)
    soft = mixed_codes(logits, torch.eye(2), "gumbel")
    (hard_gradient,) = torch.autograd.grad(drawn[..., 1].sum(), logits)
    (soft_gradient,) = torch.autograd.grad(soft[..., 1].sum(), logits)
    torch.testing.assert_close(hard_gradient, soft_gradient, rtol=0, atol=EXACT)
    assert hard_gradient.abs().max() > 0.1
    assert ((soft > 0) & (soft < 1)).all()


def test_equation_3_as_printed_lacks_the_noise_in_the_denominator():
    """exp(l_j + g_j) / sum exp(l_i): with g = log 2 everywhere all weights double, softmax stays."""
    logits = torch.tensor([[[0.0, math.log(3.0)]]])
    noise = torch.full_like(logits, math.log(2.0))
    assert token_mixture(logits, noise, as_printed=True)[0, 0].tolist() == pytest.approx([0.5, 1.5])
    assert token_mixture(logits, noise)[0, 0].tolist() == pytest.approx([0.25, 0.75])
    torch.manual_seed(0)
    sums = mixed_codes(logits.expand(1, 50, 2), torch.eye(2), "gumbel_as_printed").sum(-1)
    assert sums.std() > 0.3


@pytest.mark.parametrize("sampling", ["softmax", "gumbel", "gumbel_st", "gumbel_as_printed"])
def test_control_trains_with_every_kind_of_sampling(decoder, samplers, base, sampling):
    torch.manual_seed(4)
    recipe = ControlRecipe(
        ControlBranchConfig.tiny(), base, decoder, *samplers, options=ControlOptions(sampling=sampling)
    )
    recipe.model.train()
    recipe.loss(4)["loss"].backward()
    assert recipe.model.first_zero.weight.grad.abs().max() > 0


def test_sampling_changes_the_consistency_loss(decoder, samplers, base):
    found = {
        control_losses(decoder, samplers, base, sampling=sampling)["consistency"]
        for sampling in ("softmax", "gumbel", "gumbel_st", "gumbel_as_printed")
    }
    assert len(found) == 4


# --- consistency loss and weights (rows 4 and 6) ---


def test_the_consistency_loss_sees_the_recorded_finer_layers_unless_switched_off(decoder, samplers, base):
    """With logits that leave no doubt about the recorded base codes, the recorded motion comes out whole."""
    losses = {}
    batch = samplers[0].whole([0, 1, 2])
    certain = 1e4 * torch.nn.functional.one_hot(batch.ids[..., 0].clamp(min=0), 32).float()
    for layers in ("recorded", "none"):
        torch.manual_seed(4)
        options = ControlOptions(finer_layers=layers, masks="trajectory", drawn_share=0)
        recipe = ControlRecipe(ControlBranchConfig.tiny(), base, decoder, *samplers, options=options)
        recipe.model.forward = lambda *_: certain
        torch.manual_seed(5)
        losses[layers] = recipe._losses(batch)["consistency"].item()
        torch.manual_seed(5)
        corrupt_tokens(batch.ids[..., 0], batch.valid, codebook_size=32, mask_id=32, pad_id=33)
        mask = sample_masks("trajectory", batch.frames, joints=22, among=HUMANML3D.control_joints)
        ids = batch.ids.clone()
        ids[..., 1:] = ids[..., 1:] if layers == "recorded" else -1
        made = decoder(decoder.tokenizer.quantizer.lookup(ids) * batch.valid[..., None], batch.frames)
        targets = recover_joints(decoder.normalizer.denormalize(batch.features), joints=22)
        expected = masked_consistency_loss(made, targets, mask, norm="l1").item()
        assert losses[layers] == pytest.approx(expected, rel=1e-5)
    assert losses["recorded"] != pytest.approx(losses["none"], rel=1e-3)


def test_among_drawn_tokens_a_fresh_branch_is_natural_already(decoder, samplers, base):
    """It changes nothing of what the frozen model would choose, which is all that is asked for there."""
    steepest = {}
    for share in (0.0, 1.0):
        torch.manual_seed(4)
        options = ControlOptions(alpha=1.0, drawn_share=share, drops_text=False)
        recipe = ControlRecipe(ControlBranchConfig.tiny(), base, decoder, *samplers, options=options)
        recipe.loss(4)["loss"].backward()
        steepest[share] = recipe.model.mid_zeros[-1].weight.grad.abs().max().item()
    assert steepest[1.0] < 1e-6 < 1e-3 < steepest[0.0]


def test_drawn_tokens_come_from_one_step_of_the_controlled_model(decoder, samplers, base):
    """With logits that leave no doubt the visible tokens are those, whatever was recorded."""
    batch = samplers[0].whole([0, 1, 2])
    certain = torch.full((*batch.ids.shape[:2], 32), -1e4)
    certain[..., 7] = 0
    seen = []
    recipe = ControlRecipe(
        ControlBranchConfig.tiny(), base, decoder, *samplers, options=ControlOptions(drawn_share=1.0)
    )
    recipe.model.forward = lambda *_: certain
    embed = base.embed
    base.embed = lambda ids: seen.append(ids) or embed(ids)
    recipe._losses(batch)
    visible = seen[1][batch.valid & (seen[1] < 32)]  # in the second look; the first is of recorded ones
    assert (visible == 7).float().mean() > 0.8  # the others were made random, as in all training
    assert (seen[1][~batch.valid] == base.pad_id).all()


def test_the_norm_of_the_consistency_loss_can_be_chosen(decoder, samplers, base):
    """One controlled joint a frame: l1 is the mean coordinate, l2 the mean distance, mse the mean square."""
    found = {
        n: control_losses(decoder, samplers, base, masks="random", norm=n)["consistency"]
        for n in ("l1", "l2", "mse")
    }
    assert found["l1"] < found["l2"] < 3 * found["l1"]
    assert found["mse"] >= found["l1"] ** 2
    assert len(set(found.values())) == 3


@pytest.mark.parametrize(
    ("options", "alpha"),
    [
        ({"masks": "trajectory"}, 0.1),
        ({"masks": "mixed"}, 0.1),
        ({"masks": "random"}, 0.5),
        ({"masks": "cross"}, 0.5),
        ({"masks": "cross", "alpha": 0.1}, 0.1),
        ({"masks": "trajectory", "alpha": 0.0}, 0.0),
    ],
)
def test_alpha_goes_with_the_masks_unless_it_is_given(decoder, samplers, base, options, alpha):
    losses = control_losses(decoder, samplers, base, **options)
    expected = alpha * losses["cross_entropy"] + (1 - alpha) * losses["consistency"]
    assert losses["loss"] == pytest.approx(expected, rel=1e-5)


# --- text dropout in control training (row 7) ---


def test_text_is_dropped_in_control_training_unless_switched_off(decoder, samplers, base):
    """With a share of 1 every text is dropped; the text embedding then stops mattering."""
    base.config = replace(base.config, text_dropout=1.0)
    dropped = control_losses(decoder, samplers, base)["cross_entropy"]
    kept = control_losses(decoder, samplers, base, drops_text=False)["cross_entropy"]
    base.text_proj.weight.data.mul_(-1)
    assert control_losses(decoder, samplers, base)["cross_entropy"] == pytest.approx(dropped, rel=1e-5)
    assert control_losses(decoder, samplers, base, drops_text=False)["cross_entropy"] != pytest.approx(
        kept, rel=1e-3
    )


# --- control masks ---


def test_random_masks_name_one_of_the_six_joints_a_clip():
    torch.manual_seed(0)
    frames = frame_mask(torch.full((300,), 40), 48)
    masks = sample_masks("random", frames, joints=22, among=(0, 10, 11, 15, 20, 21))
    joints = masks.any(-1).any(1)
    assert (joints.sum(1) == 1).all()
    assert set(joints.nonzero()[:, 1].tolist()) == {0, 10, 11, 15, 20, 21}
    assert not masks[:, 40:].any()
    # n = round(U 196) is above 40 with probability 1 - 40.5 / 196: then every frame of the clip is controlled
    dense = (masks.any(-1).any(-1).sum(1) == 40).float().mean().item()
    expected = 1 - 40 / 196
    assert dense == pytest.approx(expected, abs=4.5 * math.sqrt(expected * (1 - expected) / 300))


@pytest.mark.parametrize(("masks", "joints"), [("trajectory", {0}), ("cross", {0, 10, 11, 15, 20, 21})])
def test_masks_are_chosen_by_name(masks, joints):
    torch.manual_seed(0)
    found = sample_masks(
        masks, torch.ones(50, 20, dtype=torch.bool), joints=22, among=(0, 10, 11, 15, 20, 21)
    )
    assert set(found.any(-1).flatten(0, 1).any(0).nonzero()[:, 0].tolist()) == joints


# --- corruption of the published code ---


def test_the_hidden_share_can_be_taken_of_the_padded_sequence():
    """The clip's share of 49 drawn positions: the mean stays, and short clips may keep every token."""
    torch.manual_seed(0)
    ids, valid = torch.zeros(4000, 5, dtype=torch.long), torch.ones(4000, 5, dtype=torch.bool)
    names = {"codebook_size": 32, "mask_id": 32, "pad_id": 33}
    own = corrupt_tokens(ids, valid, **names)[1].sum(1)
    padded = corrupt_tokens(ids, valid, **names, share_of=49)[1].sum(1)
    assert own.min() == 1
    assert padded.min() == 0
    # of one token among 49: hidden with probability max(1, round(49 cos)) / 49, mean 2 / pi and a little more
    assert padded.float().mean().item() == pytest.approx(5 * 2 / math.pi, abs=0.12)


# --- base retraining (row 8) ---


def masked_recipe(decoder, samplers, **options) -> MaskedRecipe:
    torch.manual_seed(5)
    recipe = MaskedRecipe(
        MaskedTransformerConfig.tiny(), decoder.tokenizer, *samplers, options=MaskedOptions(**options)
    )
    recipe.model.train()
    return recipe


def masked_losses(decoder, samplers, **options):
    recipe = masked_recipe(decoder, samplers, **options)
    torch.manual_seed(6)
    return recipe.loss(8)


def test_cross_entropy_counts_all_positions_or_the_hidden_ones(decoder, samplers):
    everywhere = masked_losses(decoder, samplers)["loss"].item()
    hidden = masked_losses(decoder, samplers, loss_on="chosen")["loss"].item()
    assert everywhere != pytest.approx(hidden, rel=1e-4)
    logits, ids = torch.randn(1, 3, 4), torch.tensor([[2, -1, 1]])
    expected = -(logits[0, 0].log_softmax(0)[2] + logits[0, 2].log_softmax(0)[1]) / 2
    torch.testing.assert_close(token_cross_entropy(logits, ids), expected)
    assert token_cross_entropy(logits, torch.full((1, 3), -1)).item() == 0


def test_the_embedding_loss_is_the_distance_to_the_encoders_output(decoder, samplers):
    plain = masked_losses(decoder, samplers)
    mixed = masked_losses(decoder, samplers, embed_loss_weight=0.9)
    torch.testing.assert_close(mixed["cross_entropy"], plain["loss"])
    torch.testing.assert_close(mixed["loss"], 0.9 * mixed["embedding"] + 0.1 * mixed["cross_entropy"])
    torch.manual_seed(6)
    recipe = masked_recipe(decoder, samplers, embed_loss_weight=1.0)
    batch = samplers[0].whole([0])
    wanted = decoder.tokenizer.encode_latents(batch.features, batch.frames)
    logits = -torch.cdist(wanted, decoder.tokenizer.base_codes)
    distance = (logits.softmax(-1) @ decoder.tokenizer.base_codes - wanted).abs().mean()
    found = recipe._objective(logits, batch.ids[..., 0], batch.valid, batch)["embedding"]
    torch.testing.assert_close(found, distance)


def test_noise_disturbs_the_one_hot_input_and_puts_mask_where_no_code_is(decoder, samplers):
    recipe = masked_recipe(decoder, samplers, logit_noise_std=0.1)
    model, ids = recipe.model, torch.tensor([[3, 32, 33]])
    table = model.token_embedding.weight
    torch.manual_seed(0)
    embedded = torch.stack([recipe._embed(ids)[0] for _ in range(3000)])
    assert torch.equal(embedded[:, 1], table[32].expand(3000, -1))
    assert torch.equal(embedded[:, 2], table[32].expand(3000, -1))
    torch.testing.assert_close(embedded[:, 0].mean(0), table[3], rtol=0, atol=5e-3)
    spread = 0.1 * table[:32].square().sum(0).sqrt()  # 32 independent entries times their rows
    torch.testing.assert_close(embedded[:, 0].std(0), spread, rtol=0.08, atol=0)
    model.eval()
    assert torch.equal(recipe._embed(ids), model.embed(ids))


def test_without_noise_the_input_is_the_embedding(decoder, samplers):
    recipe = masked_recipe(decoder, samplers)
    ids = torch.tensor([[3, 32, 33]])
    assert torch.equal(recipe._embed(ids), recipe.model.embed(ids))


# --- the tokenizer (row 22 and section 3) ---


def clips(count: int = 2) -> list[FeatureClip]:
    generator = torch.Generator().manual_seed(7)
    return [FeatureClip(f"c{i}", torch.randn(70, 263, generator=generator), (), "lab") for i in range(count)]


def rvq_losses(**options):
    torch.manual_seed(8)
    normalizer = Normalizer(torch.zeros(263), torch.ones(263))
    recipe = RvqRecipe(RvqVaeConfig.tiny(), normalizer, clips(), clips(), options=RvqOptions(**options))
    recipe.model.train()
    torch.manual_seed(9)
    return recipe.loss(4)


def test_the_published_loss_of_the_tokenizer_has_no_joint_term():
    losses = rvq_losses(joint_weight=0.0)
    expected = losses["reconstruction"] + 0.5 * losses["positions"] + 0.02 * losses["commitment"]
    torch.testing.assert_close(losses["loss"], expected)
    assert "joints" not in losses
    ours = rvq_losses()
    torch.testing.assert_close(ours["loss"], expected + ours["joints"])


def test_reconstruction_can_be_plain_l1():
    """Smooth L1 is half a squared small error, and an error of 1 or more less a half."""
    smooth, plain = rvq_losses(), rvq_losses(reconstruction="l1")
    assert smooth["reconstruction"] < plain["reconstruction"]


def test_fresh_codes_are_random_rows_or_the_first_ones():
    x = torch.randn(40, 4)
    for first in (True, False):
        torch.manual_seed(0)
        config = replace(RvqVaeConfig.tiny(), takes_first_rows=first)
        book = RvqVae(config).quantizer.book(0)
        book.codes = torch.zeros(32, 4)
        book.ema_sum = torch.zeros(32, 4)
        book.initialize(x)
        assert torch.equal(book.codes, x[:32]) == first
        assert set(map(tuple, book.codes.tolist())) <= set(map(tuple, x.tolist()))


def test_targets_of_the_recipe_are_the_recovered_joints(decoder, samplers, base):
    """Guards the other tests of this file: the loss compares joints in metres with the clip's own."""
    recipe = ControlRecipe(ControlBranchConfig.tiny(), base, decoder, *samplers)
    batch = samplers[0].whole([0])
    expected = recover_joints(decoder.normalizer.denormalize(batch.features))
    torch.testing.assert_close(recipe._joints(batch.features), expected)
