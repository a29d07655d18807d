"""Recipe of the motion control model: masked consistency training (ControlMM section 3.3)."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor

from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.models.control_branch import ControlBranch, ControlBranchConfig
from controlmm.models.masked_transformer import MaskedTransformer
from controlmm.nn.trunk import drop_text
from controlmm.ops import masked_consistency_loss, recover_joints
from controlmm.training import masked
from controlmm.training.control_masks import mixed_masks
from controlmm.training.corruption import corrupt_tokens
from controlmm.training.loop import Recipe
from controlmm.training.masked import token_cross_entropy
from controlmm.training.stage import Stage, StageInputs, best_weights, by_size, load_tokenizer
from controlmm.training.tokens import TokenBatch, TokenSampler

SETTINGS = {
    "paper": masked.SETTINGS["paper"],
    "small": dataclasses.replace(masked.SETTINGS["small"], steps=1200, batch_size=48, learning_rate=4e-4),
    "tiny": masked.SETTINGS["tiny"],
}
_VALIDATION_BATCH = 50


class ControlRecipe:
    """Cross-entropy of the tokens and distance of the joints to the targets; the base model is frozen."""

    def __init__(
        self,
        config: ControlBranchConfig,
        base: MaskedTransformer,
        decoder: MotionDecoder,
        train_tokens: TokenSampler,
        val_tokens: TokenSampler,
        *,
        alpha: float = 0.1,
    ) -> None:
        self.model = ControlBranch.beside(base, config)
        self.base = base.eval().requires_grad_(False)
        self.decoder = decoder
        self.alpha = alpha  # share of the cross-entropy; the rest is the consistency loss
        self._train, self._val = train_tokens, val_tokens

    def loss(self, batch_size: int) -> dict[str, Tensor]:
        """Losses of a random batch under random controls."""
        return self._losses(self._train.sample(batch_size))

    def validate(self) -> dict[str, float]:
        """Losses on the validation clips; ``consistency`` is the mean error of a coordinate in metres."""
        totals: dict[str, float] = {}
        for first in range(0, len(self._val), _VALIDATION_BATCH):
            indices = range(first, min(first + _VALIDATION_BATCH, len(self._val)))
            for name, value in self._losses(self._val.whole(indices)).items():
                totals[name] = totals.get(name, 0.0) + value.item() * len(indices) / len(self._val)
        return {"score": totals["loss"], **totals}

    def describe(self) -> dict[str, Any]:
        """Options of this recipe."""
        return {"stage": "control", "alpha": self.alpha}

    def _losses(self, batch: TokenBatch) -> dict[str, Tensor]:
        base, frames = self.base, batch.frames
        ids = batch.ids[..., 0]
        corrupted, _ = corrupt_tokens(
            ids,
            batch.valid,
            codebook_size=base.config.codebook_size,
            mask_id=base.mask_id,
            pad_id=base.pad_id,
        )
        with torch.no_grad():
            targets = self._joints(batch.features)
            current = self.decoder(self.decoder.base_latents(corrupted, batch.valid), frames)
        skeleton = self.decoder.normalizer.skeleton
        mask = mixed_masks(frames, joints=skeleton.num_joints, favoured=skeleton.control_joints)

        text = drop_text(batch.text, base.config.text_dropout) if self.model.training else batch.text
        sequence = base.sequence(base.embed(corrupted), text)
        logits = self.model(base, sequence, self.model.signal(targets, mask, current), batch.valid).float()
        soft = (logits.softmax(-1) @ self.decoder.tokenizer.base_codes) * batch.valid[..., None]
        consistency = masked_consistency_loss(self.decoder(soft, frames), targets, mask, norm="l1")
        tokens = token_cross_entropy(logits, ids)
        loss = self.alpha * tokens + (1 - self.alpha) * consistency
        return {"loss": loss, "cross_entropy": tokens, "consistency": consistency}

    def _joints(self, features: Tensor) -> Tensor:
        return recover_joints(
            self.decoder.normalizer.denormalize(features), joints=self.decoder.normalizer.skeleton.num_joints
        )


def _build(config: ControlBranchConfig, inputs: StageInputs) -> Recipe:
    decoder = MotionDecoder(*load_tokenizer(inputs.root))
    base = MaskedTransformer.from_pretrained(best_weights(inputs.root, "masked"))
    config = config.for_skeleton(decoder.normalizer.skeleton)
    return ControlRecipe(config, base, decoder, *inputs.token_samplers())


STAGE = Stage("control", _build, by_size(ControlBranchConfig), SETTINGS, ("rvq", "masked"), network="control")
