"""Recipe of the residual control: residual layers that make up for what the base layer misses."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import cross_entropy

from controlmm.generation.controlled_layers import ControlledLayers, without_base
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.models.masked_transformer import MaskedTransformer
from controlmm.models.residual_control import ResidualControl, ResidualControlConfig
from controlmm.models.residual_transformer import ResidualTransformer
from controlmm.nn.quantizer import ResidualQuantizer
from controlmm.nn.trunk import drop_text
from controlmm.ops import masked_consistency_loss, recover_joints
from controlmm.training import masked
from controlmm.training.control_masks import MaskMode, sample_masks
from controlmm.training.corruption import corrupt_tokens
from controlmm.training.recipe import Recipe
from controlmm.training.residual import random_layers
from controlmm.training.samples import clips_with_controlled_layers
from controlmm.training.soft_tokens import drawn_ids
from controlmm.training.stage import Stage, StageInputs, best_weights, by_size, load_tokenizer
from controlmm.training.tokens import TokenBatch, TokenSampler

SETTINGS = {
    **masked.SETTINGS,
    "small": dataclasses.replace(masked.SETTINGS["small"], steps=2500, batch_size=48, learning_rate=1e-3),
}
_VALIDATION_BATCH = 64


@dataclass(frozen=True)
class ResidualControlOptions:
    """How the residual control is trained."""

    masks: MaskMode = "mixed"
    alpha: float = 0.1  # share of the cross-entropy, the rest is consistency
    drawn_share: float = 0.6  # of the clips whose base layer the masked transformer draws, as in decoding

    def __post_init__(self) -> None:
        for name in ("alpha", "drawn_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"`{name}` must be in [0, 1], got {getattr(self, name)}.")


class ResidualControlRecipe:
    """Distance of the joints to the targets after one residual layer, and how natural its codes are.

    Natural are, above a recorded base layer, the recorded codes; above one that the masked transformer drew,
    what the residual transformer would choose without targets.
    """

    def __init__(
        self,
        config: ResidualControlConfig,
        base: MaskedTransformer,
        residual: ResidualTransformer,
        decoder: MotionDecoder,
        train_tokens: TokenSampler,
        val_tokens: TokenSampler,
        *,
        options: ResidualControlOptions = ResidualControlOptions(),
    ) -> None:
        config.check_base(residual.config)
        self.model = ResidualControl(config)
        self.base = base.eval().requires_grad_(False)
        self.residual = residual.eval().requires_grad_(False)
        self.decoder = decoder
        self.options = options
        self._train, self._val = train_tokens, val_tokens

    def loss(self, batch_size: int) -> dict[str, Tensor]:
        """Losses of a random batch under random controls, in one random layer."""
        layer = int(random_layers(1, self.residual.config.num_quantizers))
        return self._losses(self._train.sample(batch_size), layer)

    def validate(self) -> dict[str, float]:
        """Losses on the validation clips, over all layers alike; ``consistency`` is that of the last layer.

        Which is the mean error of a coordinate in metres when all layers are filled in.
        """
        totals: dict[str, float] = {}
        layers = range(1, self.residual.config.num_quantizers)
        for first in range(0, len(self._val), _VALIDATION_BATCH):
            indices = range(first, min(first + _VALIDATION_BATCH, len(self._val)))
            batch, share = self._val.whole(indices), len(indices) / len(self._val)
            for layer in layers:
                losses = {name: value.item() for name, value in self._losses(batch, layer).items()}
                for name in ("loss", "cross_entropy"):
                    totals[name] = totals.get(name, 0.0) + losses[name] * share / len(layers)
                if layer in (layers[0], layers[-1]):
                    name = "consistency" if layer == layers[-1] else "consistency_first"
                    totals[name] = totals.get(name, 0.0) + losses["consistency"] * share
        return {"score": totals["loss"], **totals}

    def describe(self) -> dict[str, Any]:
        """Options of this recipe."""
        return {"stage": "residual-control"}

    def _losses(self, batch: TokenBatch, layer: int) -> dict[str, Tensor]:
        device, skeleton = self.model.device, self.decoder.normalizer.skeleton
        base, decoder = self.base.to(device), self.decoder.to(device)
        is_drawn = (torch.rand(len(batch.ids)) < self.options.drawn_share).to(device)
        corrupted = self._corrupted(batch).to(device)
        mask = sample_masks(
            self.options.masks, batch.frames, joints=skeleton.num_joints, among=skeleton.control_joints
        ).to(device)
        batch = batch.to(device)
        with torch.no_grad():
            features = decoder.normalizer.denormalize(batch.features)
            targets = recover_joints(features, joints=skeleton.num_joints)
            drawn = drawn_ids(base(base.embed(corrupted), batch.text, batch.valid))
            first = torch.where(is_drawn[:, None] & batch.valid, drawn, batch.ids[..., 0])
            control = ControlledLayers(
                self.model, decoder, targets, mask, decoder.tokenizer.quantizer.lookup(first[..., None])
            )
            ids = self._layers_before(layer, first, batch, is_drawn, control)
        logits, natural = self._logits(ids, layer, batch, is_drawn, control)
        latents = control.base + decoder.tokenizer.quantizer.lookup(without_base(ids))
        latents = latents + self._chosen(logits, layer) * batch.valid[..., None]
        latents = latents + self._recorded_after(layer, batch, ~is_drawn)
        joints, metres = decoder(latents, batch.frames), skeleton.metres
        consistency = masked_consistency_loss(joints * metres, targets * metres, mask, norm="l1")
        tokens = cross_entropy(logits[batch.valid], natural[batch.valid])
        loss = self.options.alpha * tokens + (1 - self.options.alpha) * consistency
        return {"loss": loss, "cross_entropy": tokens, "consistency": consistency}

    def _corrupted(self, batch: TokenBatch) -> Int[Tensor, "B L"]:
        base = self.base
        corrupted, _ = corrupt_tokens(
            batch.ids[..., 0],
            batch.valid,
            codebook_size=base.config.codebook_size,
            mask_id=base.mask_id,
            pad_id=base.pad_id,
        )
        return corrupted

    def _layers_before(
        self,
        layer: int,
        first: Int[Tensor, "B L"],
        batch: TokenBatch,
        is_drawn: Bool[Tensor, "B"],
        control: ControlledLayers,
    ) -> Int[Tensor, "B L Q"]:
        """Codes of the layers below ``layer``, -1 above: recorded, or chosen under control as in decoding."""
        ids = torch.full_like(batch.ids, -1)
        ids[..., 0] = first
        training = self.model.training
        self.model.eval()
        for earlier in range(1, layer):
            chosen = self._controlled(ids, earlier, batch.text, batch.valid, control).argmax(-1)
            chosen = torch.where(is_drawn[:, None], chosen, batch.ids[..., earlier])
            ids[..., earlier] = torch.where(batch.valid, chosen, -1)
        self.model.train(training)
        return ids

    def _logits(
        self,
        ids: Int[Tensor, "B L Q"],
        layer: int,
        batch: TokenBatch,
        is_drawn: Bool[Tensor, "B"],
        control: ControlledLayers,
    ) -> tuple[Float[Tensor, "B L K"], Float[Tensor, "B L K"]]:
        """Logits of ``layer`` under control, and the probabilities that count as natural."""
        text = drop_text(batch.text, self.residual.config.text_dropout) if self.model.training else batch.text
        logits = self._controlled(ids, layer, text, batch.valid, control)
        with torch.no_grad():
            number = torch.full((len(ids),), layer, device=ids.device)
            free = self.residual(self.residual.history(ids, number), number, text, batch.valid)
            free = free[..., : self.residual.pad_id].float().softmax(-1)
            recorded = torch.nn.functional.one_hot(batch.ids[..., layer].clamp(min=0), free.shape[-1])
        return logits, torch.where(is_drawn[:, None, None], free, recorded.to(free.dtype))

    def _controlled(
        self,
        ids: Int[Tensor, "B L Q"],
        layer: int,
        text: Float[Tensor, "B E"],
        valid: Bool[Tensor, "B L"],
        control: ControlledLayers,
    ) -> Float[Tensor, "B L K"]:
        residual = self.residual.to(self.model.device)
        number = torch.full((len(ids),), layer, device=ids.device)
        hints = control.hints(ids, number, valid)
        logits: Tensor = residual(residual.history(ids, number), number, text, valid, hints)
        return logits[..., : residual.pad_id].float()

    def _chosen(self, logits: Float[Tensor, "B L K"], layer: int) -> Float[Tensor, "B L C"]:
        """The likeliest codes, as in decoding, with the gradient of the mean code."""
        quantizer = self.decoder.tokenizer.quantizer
        assert isinstance(quantizer, ResidualQuantizer)  # the only kind with layers
        codes = quantizer.book(layer).codes
        mean = logits.softmax(-1) @ codes
        return mean + (codes[logits.argmax(-1)] - mean).detach()

    def _recorded_after(
        self, layer: int, batch: TokenBatch, is_recorded: Bool[Tensor, "B"]
    ) -> Float[Tensor, "B L C"]:
        """What the recorded layers above ``layer`` add to recorded base layers."""
        ids = batch.ids.clone()
        ids[..., : layer + 1] = -1
        ids[~is_recorded] = -1
        latents: Tensor = self.decoder.tokenizer.quantizer.lookup(ids)
        return latents


def _build(config: ResidualControlConfig, inputs: StageInputs) -> Recipe:
    decoder = MotionDecoder(*load_tokenizer(inputs.root))
    base = MaskedTransformer.from_pretrained(best_weights(inputs.root, "masked"))
    residual = ResidualTransformer.from_pretrained(best_weights(inputs.root, "residual"))
    config = config.for_skeleton(decoder.normalizer.skeleton)
    return ResidualControlRecipe(
        config, base, residual, decoder, *inputs.token_samplers(), options=inputs.options
    )


STAGE = Stage(
    "residual-control",
    _build,
    by_size(ResidualControlConfig),
    SETTINGS,
    ("rvq", "masked", "residual"),
    network="residual_control",
    options=ResidualControlOptions(),
    samples=clips_with_controlled_layers,
)
