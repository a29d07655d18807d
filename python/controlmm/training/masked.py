"""Recipe of the masked transformer."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torch.nn.functional import cross_entropy

from controlmm.models.masked_transformer import MaskedTransformer, MaskedTransformerConfig
from controlmm.nn.trunk import drop_text
from controlmm.training.corruption import corrupt_tokens
from controlmm.training.loop import Recipe
from controlmm.training.settings import TrainingSettings
from controlmm.training.stage import Stage, StageInputs, by_size
from controlmm.training.tokens import TokenBatch, TokenSampler

SETTINGS = {
    "paper": TrainingSettings(
        steps=180_000, batch_size=64, milestones=(50_000,), weight_decay=1e-5, clip_norm=0.0, bf16=False
    ),
    "small": TrainingSettings(steps=3000, batch_size=64, learning_rate=5e-4, warmup=300, weight_decay=0.01),
    "tiny": TrainingSettings(
        steps=20,
        batch_size=8,
        learning_rate=1e-3,
        warmup=2,
        validate_every=10,
        checkpoint_every=5,
        bf16=False,
    ),
}
_VALIDATION_BATCH = 64


class MaskedRecipe:
    """Cross-entropy on all positions of partly masked base tokens (ControlMM section 3.2)."""

    def __init__(
        self, config: MaskedTransformerConfig, train_tokens: TokenSampler, val_tokens: TokenSampler
    ) -> None:
        self.model = MaskedTransformer(config)
        self._train, self._val = train_tokens, val_tokens

    def loss(self, batch_size: int) -> dict[str, Tensor]:
        """Loss and accuracy of a random batch."""
        return self._losses(self._train.sample(batch_size))

    def validate(self) -> dict[str, float]:
        """Loss and accuracy on the validation clips, with their own captions and without text."""
        totals: dict[str, float] = {}
        for first in range(0, len(self._val), _VALIDATION_BATCH):
            indices = range(first, min(first + _VALIDATION_BATCH, len(self._val)))
            losses = self._losses(self._val.whole(indices))
            for name, value in losses.items():
                totals[name] = totals.get(name, 0.0) + value.item() * len(indices) / len(self._val)
        return {"score": totals["loss"], **totals}

    def describe(self) -> dict[str, Any]:
        """Options of this recipe."""
        return {"stage": "masked"}

    def _losses(self, batch: TokenBatch) -> dict[str, Tensor]:
        base = batch.ids[..., 0]
        corrupted, chosen = corrupt_tokens(
            base,
            batch.valid,
            codebook_size=self.model.config.codebook_size,
            mask_id=self.model.mask_id,
            pad_id=self.model.pad_id,
        )
        text = drop_text(batch.text, self.model.config.text_dropout) if self.model.training else batch.text
        logits = self.model(self.model.embed(corrupted), text, batch.valid).float()
        right = logits.argmax(-1) == base
        return {
            "loss": token_cross_entropy(logits, base),
            "accuracy_hidden": right[chosen].float().mean(),
            "accuracy": right[batch.valid].float().mean(),
        }


def token_cross_entropy(logits: Tensor, ids: Tensor) -> Tensor:
    """Mean cross-entropy over the positions whose id is not -1. ``logits`` (B, L, K), ``ids`` (B, L)."""
    return cross_entropy(logits.flatten(0, 1), ids.flatten(), ignore_index=-1)


def _build(config: MaskedTransformerConfig, inputs: StageInputs) -> Recipe:
    assert inputs.text_encoder is not None  # the stage uses text
    return MaskedRecipe(config.for_text(inputs.text_encoder.dim), *inputs.token_samplers())


STAGE = Stage("masked", _build, by_size(MaskedTransformerConfig), SETTINGS, ("rvq",), network="transformer")
