"""Recipe of the masked transformer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from controlmm.models.masked_transformer import MaskedTransformer, MaskedTransformerConfig
from controlmm.models.rvq_vae import RvqVae
from controlmm.nn.trunk import drop_text
from controlmm.training.corruption import corrupt_tokens
from controlmm.training.recipe import Recipe
from controlmm.training.samples import clips_from_text
from controlmm.training.settings import TINY, TrainingSettings
from controlmm.training.stage import Stage, StageInputs, by_size, load_tokenizer
from controlmm.training.tokens import TokenBatch, TokenSampler

SETTINGS = {
    "paper": TrainingSettings(
        steps=180_000, batch_size=64, milestones=(50_000,), weight_decay=1e-5, clip_norm=0.0, bf16=False
    ),
    "small": TrainingSettings(steps=3000, batch_size=64, learning_rate=5e-4, warmup=300, weight_decay=0.01),
    "tiny": TINY,
}
_VALIDATION_BATCH = 64


@dataclass(frozen=True)
class MaskedOptions:
    """Where MoMask, ControlMM's paper and its published code train the base in different ways."""

    loss_on: Literal["all", "chosen"] = (
        "all"  # the paper retrains on all positions, MoMask on the hidden ones
    )
    embed_loss_weight: float = 0.0  # share of the L1 distance to the encoder's output; published code: 0.9
    logit_noise_std: float = 0.0  # of the noise on the one-hot input tokens; published code: 0.1
    share_of: int | None = (
        None  # of how many positions the hidden share is taken, None: of the clip's; code: 49
    )

    def __post_init__(self) -> None:
        if self.loss_on not in ("all", "chosen"):
            raise ValueError(f"`loss_on` must be 'all' or 'chosen', got {self.loss_on!r}.")
        if not 0 <= self.embed_loss_weight <= 1 or not self.logit_noise_std >= 0:
            raise ValueError(
                "`embed_loss_weight` must be in [0, 1] and `logit_noise_std` not negative, got "
                f"{self.embed_loss_weight} and {self.logit_noise_std}."
            )
        if self.share_of is not None and self.share_of < 1:
            raise ValueError(f"`share_of` must be at least 1, got {self.share_of}.")


class MaskedRecipe:
    """Cross-entropy of partly masked base tokens (ControlMM section 3.2), by default on all positions."""

    def __init__(
        self,
        config: MaskedTransformerConfig,
        tokenizer: RvqVae,
        train_tokens: TokenSampler,
        val_tokens: TokenSampler,
        *,
        options: MaskedOptions = MaskedOptions(),
    ) -> None:
        self.model = MaskedTransformer(config)
        self.tokenizer = tokenizer.eval().requires_grad_(False)
        self.options = options
        self._train, self._val = train_tokens, val_tokens

    def loss(self, batch_size: int) -> dict[str, Tensor]:
        """Loss and accuracy of a random batch."""
        return self._losses(self._train.sample(batch_size))

    def validate(self) -> dict[str, float]:
        """Loss and accuracy on the validation clips with their first captions.

        The score is the share of hidden tokens that are guessed wrong, as MoMask keeps its best weights: the
        cross-entropy rises as the network grows sure of itself, long before its motions get worse.
        """
        totals: dict[str, float] = {}
        for first in range(0, len(self._val), _VALIDATION_BATCH):
            indices = range(first, min(first + _VALIDATION_BATCH, len(self._val)))
            losses = self._losses(self._val.whole(indices))
            for name, value in losses.items():
                totals[name] = totals.get(name, 0.0) + value.item() * len(indices) / len(self._val)
        return {"score": 1 - totals["accuracy_hidden"], **totals}

    def describe(self) -> dict[str, Any]:
        """Options of this recipe."""
        return {"stage": "masked"}

    def _losses(self, batch: TokenBatch) -> dict[str, Tensor]:
        corrupted, chosen = corrupt_tokens(
            batch.ids[..., 0],
            batch.valid,
            codebook_size=self.model.config.codebook_size,
            mask_id=self.model.mask_id,
            pad_id=self.model.pad_id,
            share_of=self.options.share_of,
        )
        device = self.model.device
        batch, corrupted, chosen = batch.to(device), corrupted.to(device), chosen.to(device)
        base = batch.ids[..., 0]
        text = drop_text(batch.text, self.model.config.text_dropout) if self.model.training else batch.text
        logits = self.model(self._embed(corrupted), text, batch.valid).float()
        right = logits.argmax(-1) == base
        return {
            **self._objective(logits, base, chosen, batch),
            "accuracy_hidden": right[chosen].float().sum() / chosen.sum().clamp(min=1),
            "accuracy": right[batch.valid].float().mean(),
        }

    def _embed(self, ids: Tensor) -> Tensor:
        """Embeddings; with noise, of disturbed one-hot codes, and of MASK wherever there is no code."""
        if not (self.options.logit_noise_std and self.model.training):
            return self.model.embed(ids)
        codes = self.model.config.codebook_size
        is_code = (ids < codes)[..., None]
        one_hot = nn.functional.one_hot(ids.clamp(max=codes - 1), codes).float()
        noise = torch.randn_like(one_hot) * self.options.logit_noise_std
        mask_embedding = self.model.token_embedding.weight[self.model.mask_id]
        return torch.where(is_code, self.model.embed_soft(one_hot + noise), mask_embedding)

    def _objective(
        self, logits: Tensor, base: Tensor, chosen: Tensor, batch: TokenBatch
    ) -> dict[str, Tensor]:
        tokens = token_cross_entropy(
            logits, base if self.options.loss_on == "all" else base.where(chosen, -1)
        )
        weight = self.options.embed_loss_weight
        if not weight:
            return {"loss": tokens}
        with torch.no_grad():
            wanted = self.tokenizer.to(batch.ids.device).encode_latents(batch.features, batch.frames)
        found = logits.softmax(-1) @ self.tokenizer.base_codes
        embedding = (found - wanted).abs()[batch.valid].mean()
        loss = weight * embedding + (1 - weight) * tokens
        return {"loss": loss, "cross_entropy": tokens, "embedding": embedding}


def token_cross_entropy(logits: Tensor, ids: Tensor) -> Tensor:
    """Mean cross-entropy over the positions whose id is not -1. ``logits`` (B, L, K), ``ids`` (B, L).

    0 when there are none.
    """
    total = cross_entropy(logits.flatten(0, 1), ids.flatten(), ignore_index=-1, reduction="sum")
    return total / (ids >= 0).sum().clamp(min=1)


def _build(config: MaskedTransformerConfig, inputs: StageInputs) -> Recipe:
    assert inputs.text_encoder is not None  # the stage uses text
    tokenizer, _ = load_tokenizer(inputs.root)
    config = config.for_text(inputs.text_encoder.dim)
    return MaskedRecipe(config, tokenizer, *inputs.token_samplers(), options=inputs.options)


STAGE = Stage(
    "masked",
    _build,
    by_size(MaskedTransformerConfig),
    SETTINGS,
    ("rvq",),
    network="transformer",
    options=MaskedOptions(),
    samples=clips_from_text,
)
