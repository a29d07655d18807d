"""One control training step against the published procedure, written down from its description.

The draws (batch, corruption, masks) are the recipe's own, in its order; signal, logits, soft tokens, motion
and both losses are computed here, clip by clip, so that nothing depends on padding.
"""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch.nn.functional import cross_entropy

from controlmm.data import Caption, FeatureClip
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.models.control_branch import ControlBranchConfig
from controlmm.models.masked_transformer import MaskedTransformer, MaskedTransformerConfig
from controlmm.models.rvq_vae import RvqVae, RvqVaeConfig
from controlmm.motion.normalizer import Normalizer
from controlmm.ops import recover_joints
from controlmm.training.control import ControlOptions, ControlRecipe
from controlmm.training.control_masks import cross_masks, trajectory_masks
from controlmm.training.corruption import corrupt_tokens
from controlmm.training.tokens import TokenSampler

SIX = (0, 10, 11, 15, 20, 21)
CLOSE = {"rtol": 1e-4, "atol": 1e-5}  # float32 sums in another order
SEED, CLIPS = 3, 4


def make_recipe(masks: str, joints: tuple[int, ...]) -> ControlRecipe:
    torch.manual_seed(0)
    tokenizer = RvqVae(RvqVaeConfig.tiny()).eval()
    for book in tokenizer.quantizer.books:
        book.codes.normal_()
    decoder = MotionDecoder(tokenizer, Normalizer(torch.zeros(263), torch.full((263,), 0.05)))
    clips = [
        FeatureClip(f"clip{i}", 0.05 * torch.randn(50 + 9 * i, 263), (Caption("walks"),), "lab")
        for i in range(3)
    ]
    text = {"walks": torch.randn(64)}
    samplers = [TokenSampler(clips, decoder.normalizer, tokenizer, text, progress=False) for _ in range(2)]
    base = MaskedTransformer(MaskedTransformerConfig.tiny())
    base.head[-1].weight.data.mul_(30)
    config = dataclasses.replace(
        ControlBranchConfig.tiny(), joints=joints, has_observation_mask=False, sees_missing_speed=False
    )
    options = ControlOptions(masks=masks, drops_text=False, finer_layers="none", drawn_share=0)
    recipe = ControlRecipe(config, base, decoder, *samplers, options=options)
    for zero in (recipe.model.first_zero, *recipe.model.mid_zeros):
        torch.nn.init.normal_(zero.weight, std=0.1)
    recipe.model.train()
    return recipe


def published_losses(recipe: ControlRecipe, masks: str, joints: tuple[int, ...]) -> dict[str, torch.Tensor]:
    base, decoder = recipe.base, recipe.decoder
    codes, denormalize = decoder.tokenizer.base_codes, decoder.normalizer.denormalize
    torch.manual_seed(SEED)
    batch = recipe._train.sample(CLIPS)
    ids = batch.ids[..., 0]
    corrupted, _ = corrupt_tokens(
        ids, batch.valid, codebook_size=len(codes), mask_id=base.mask_id, pad_id=base.pad_id
    )
    if masks == "cross":
        mask = cross_masks(batch.frames, joints=22, among=SIX)
    else:
        mask = trajectory_masks(batch.frames, joints=22)

    token_losses, coordinate_errors = [], []
    for clip in range(CLIPS):
        tokens = int(batch.valid[clip].sum())
        frames = 4 * tokens
        own, held = ids[clip, :tokens], mask[clip, :frames].any(-1)
        target = recover_joints(denormalize(batch.features[clip, :frames]))
        seen = corrupted[clip, :tokens]
        latents = torch.stack([codes[i] if i < len(codes) else codes.mean(0) for i in seen.tolist()])
        current = recover_joints(denormalize(decoder.tokenizer.decode(latents[None])[0]))
        control = torch.cat(
            [
                ((target - current) * held[..., None])[:, list(joints)].flatten(1),
                (target * held[..., None])[:, list(joints)].flatten(1),
            ],
            dim=1,
        )
        all_valid = torch.ones(1, tokens, dtype=torch.bool)
        sequence = base.sequence(base.token_embedding(seen)[None], batch.text[clip : clip + 1])
        logits = recipe.model(base, sequence, control[None], all_valid)[0]
        token_losses.append(cross_entropy(logits, own, reduction="none"))
        soft = decoder.tokenizer.decode((logits.softmax(-1) @ codes)[None])[0]
        joints_found = recover_joints(denormalize(soft))
        coordinate_errors.append((joints_found - target).abs()[held].flatten())
    alpha = {"trajectory": 0.1, "cross": 0.5}[masks]
    tokens_loss, consistency = torch.cat(token_losses).mean(), torch.cat(coordinate_errors).mean()
    loss = alpha * tokens_loss + (1 - alpha) * consistency
    return {"loss": loss, "cross_entropy": tokens_loss, "consistency": consistency}


@pytest.mark.parametrize(("masks", "joints"), [("trajectory", (0,)), ("cross", SIX)])
def test_a_control_training_step_is_the_published_one(masks, joints):
    """Published layout, weights of the losses, masks; mean cross-entropy, mean absolute coordinate error."""
    recipe = make_recipe(masks, joints)
    expected = published_losses(recipe, masks, joints)
    torch.manual_seed(SEED)
    found = recipe.loss(CLIPS)
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, **CLOSE)
    gradients = [
        torch.autograd.grad(losses["loss"], recipe.model.parameters(), allow_unused=True)
        for losses in (found, expected)
    ]
    for ours, theirs in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-5)
    assert all(parameter.grad is None for parameter in recipe.base.parameters())
