"""Recipe of the residual transformer."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from controlmm.models.residual_transformer import ResidualTransformer, ResidualTransformerConfig
from controlmm.nn.trunk import drop_text
from controlmm.training import masked
from controlmm.training.masked import token_cross_entropy
from controlmm.training.recipe import Recipe
from controlmm.training.samples import clips_with_residual_layers
from controlmm.training.stage import Stage, StageInputs, by_size
from controlmm.training.tokens import TokenBatch, TokenSampler

SETTINGS = {
    **masked.SETTINGS,
    "small": dataclasses.replace(masked.SETTINGS["small"], steps=1400),
}
_VALIDATION_BATCH = 64


class ResidualRecipe:
    """Cross-entropy of one random residual layer, given the true codes of the layers before it."""

    def __init__(
        self, config: ResidualTransformerConfig, train_tokens: TokenSampler, val_tokens: TokenSampler
    ) -> None:
        self.model = ResidualTransformer(config)
        self._train, self._val = train_tokens, val_tokens

    def loss(self, batch_size: int) -> dict[str, Tensor]:
        """Loss and accuracy of a random batch, one random layer for each clip."""
        batch = self._train.sample(batch_size)
        return self._losses(batch, random_layers(batch_size, self.model.config.num_quantizers))

    def validate(self) -> dict[str, float]:
        """Loss and accuracy on the validation clips, over all layers alike."""
        totals: dict[str, float] = {}
        layers = range(1, self.model.config.num_quantizers)
        for first in range(0, len(self._val), _VALIDATION_BATCH):
            indices = range(first, min(first + _VALIDATION_BATCH, len(self._val)))
            batch = self._val.whole(indices)
            for layer in layers:
                losses = self._losses(batch, torch.full((len(indices),), layer))
                for name, value in losses.items():
                    share = len(indices) / len(self._val) / len(layers)
                    totals[name] = totals.get(name, 0.0) + value.item() * share
        return {"score": totals["loss"], **totals}

    def describe(self) -> dict[str, Any]:
        """Options of this recipe."""
        return {"stage": "residual"}

    def _losses(self, batch: TokenBatch, layer: Int[Tensor, "B"]) -> dict[str, Tensor]:
        batch, layer = batch.to(self.model.device), layer.to(self.model.device)
        text = drop_text(batch.text, self.model.config.text_dropout) if self.model.training else batch.text
        logits = self.model(self.model.history(batch.ids, layer), layer, text, batch.valid).float()
        target = batch.ids.gather(2, layer[:, None, None].expand(-1, batch.ids.shape[1], 1)).squeeze(2)
        right = logits.argmax(-1) == target
        return {
            "loss": token_cross_entropy(logits, target),
            "accuracy": right[batch.valid].float().mean(),
        }


def random_layers(count: int, num_quantizers: int) -> Int[Tensor, "B"]:
    """Layers 1..Q-1, early ones more often: ``1 + round((1 - cos(pi u / 2)) (Q - 2))``, u uniform."""
    progress = 1 - torch.cos(0.5 * math.pi * torch.rand(count))
    return 1 + (progress * (num_quantizers - 2)).round().long()


def _build(config: ResidualTransformerConfig, inputs: StageInputs) -> Recipe:
    assert inputs.text_encoder is not None  # the stage uses text
    return ResidualRecipe(config.for_text(inputs.text_encoder.dim), *inputs.token_samplers())


STAGE = Stage(
    "residual",
    _build,
    by_size(ResidualTransformerConfig),
    SETTINGS,
    ("rvq",),
    network="residual",
    samples=clips_with_residual_layers,
)
