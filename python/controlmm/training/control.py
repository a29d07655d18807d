"""Recipe of the motion control model: masked consistency training (ControlMM section 3.3)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import cross_entropy, one_hot

from controlmm.generation.controlled_layers import without_base
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.models.control_branch import ControlBranch, ControlBranchConfig
from controlmm.models.masked_transformer import MaskedTransformer
from controlmm.nn.trunk import drop_text
from controlmm.ops import masked_consistency_loss, recover_joints
from controlmm.ops.consistency import Norm
from controlmm.training import masked
from controlmm.training.control_masks import MaskMode, sample_masks
from controlmm.training.corruption import corrupt_tokens
from controlmm.training.masked import token_cross_entropy
from controlmm.training.recipe import Recipe
from controlmm.training.samples import clips_with_control
from controlmm.training.soft_tokens import Sampling, drawn_ids, mixed_codes
from controlmm.training.stage import Stage, StageInputs, best_weights, by_size, load_tokenizer
from controlmm.training.tokens import TokenBatch, TokenSampler

SETTINGS = {
    "paper": masked.SETTINGS["paper"],
    "small": dataclasses.replace(masked.SETTINGS["small"], steps=1200, batch_size=48, learning_rate=4e-4),
    "tiny": masked.SETTINGS["tiny"],
}
# The paper's value is 0.1; the published weights for six joints were trained with 0.5.
_ALPHA: dict[MaskMode, float] = {"mixed": 0.1, "trajectory": 0.1, "random": 0.5, "cross": 0.5}
_VALIDATION_BATCH = 50

FinerLayers = Literal["recorded", "none"]


@dataclass(frozen=True)
class ControlOptions:
    """Where ControlMM's paper and its published code train the control branch in different ways."""

    masks: MaskMode = "mixed"  # published: trajectory (pelvis model), random, cross (six joints)
    alpha: float | None = None  # share of the cross-entropy, the rest is consistency; None: by `masks`
    sampling: Sampling = "softmax"  # paper: gumbel_st; of the tokens that the consistency loss decodes
    norm: Norm = "l1"  # of the consistency loss; paper: l2, a distance for each controlled joint
    drops_text: bool = True  # as the paper; the published code never does
    share_of: int | None = None  # as in `MaskedOptions`
    # Residual codes in the motion that the consistency loss sees; published: none. Base codes alone miss even
    # their own recording's path by far, so without finer layers this loss pulls against the cross-entropy.
    finer_layers: FinerLayers = "recorded"
    # Of the clips whose visible tokens the model has drawn itself, as in decoding, where it has to make up
    # for their drift; published: none. They are compared with what the frozen model would choose there.
    drawn_share: float = 0.5

    def __post_init__(self) -> None:
        for name, kind in (
            ("masks", MaskMode),
            ("sampling", Sampling),
            ("norm", Norm),
            ("finer_layers", FinerLayers),
        ):
            if getattr(self, name) not in get_args(kind):
                raise ValueError(f"`{name}` must be one of {get_args(kind)}, got {getattr(self, name)!r}.")
        if not 0 <= self.drawn_share <= 1:
            raise ValueError(f"`drawn_share` must be in [0, 1], got {self.drawn_share}.")
        if self.alpha is not None and not 0 <= self.alpha <= 1:
            raise ValueError(f"`alpha` must be in [0, 1], got {self.alpha}.")
        if self.share_of is not None and self.share_of < 1:
            raise ValueError(f"`share_of` must be at least 1, got {self.share_of}.")

    @property
    def cross_entropy_share(self) -> float:
        """``alpha``, or the value that goes with the kind of masks."""
        return _ALPHA[self.masks] if self.alpha is None else self.alpha


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
        options: ControlOptions = ControlOptions(),
    ) -> None:
        self.model = ControlBranch.beside(base, config)
        self.base = base.eval().requires_grad_(False)
        self.decoder = decoder
        self.options = options
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
        return {"stage": "control", "alpha": self.options.cross_entropy_share}

    def _losses(self, batch: TokenBatch) -> dict[str, Tensor]:
        device, skeleton = self.model.device, self.decoder.normalizer.skeleton
        self.base, self.decoder = self.base.to(device), self.decoder.to(device)
        is_drawn = torch.zeros(len(batch.ids), dtype=torch.bool, device=device)
        if self.options.drawn_share:  # else no random number is taken, as in the published training
            is_drawn = (torch.rand(len(is_drawn)) < self.options.drawn_share).to(device)
        corrupted = self._corrupted(batch.ids[..., 0], batch.valid).to(device)
        mask = sample_masks(
            self.options.masks, batch.frames, joints=skeleton.num_joints, among=skeleton.control_joints
        ).to(device)
        batch = batch.to(device)
        targets = self._joints(batch.features)
        if is_drawn.any():
            drawn = self._drawn(corrupted, batch, targets, mask)
            again = self._corrupted(drawn.cpu(), batch.valid.cpu()).to(device)
            corrupted = torch.where(is_drawn[:, None], again, corrupted)

        drops_text = self.model.training and self.options.drops_text
        text = drop_text(batch.text, self.base.config.text_dropout) if drops_text else batch.text
        logits = self._logits(corrupted, text, batch, targets, mask)
        tokens = self._cross_entropy(logits, corrupted, text, batch, is_drawn)
        consistency = self._consistency(logits, batch, targets, mask, is_drawn)
        alpha = self.options.cross_entropy_share
        loss = alpha * tokens + (1 - alpha) * consistency
        return {"loss": loss, "cross_entropy": tokens, "consistency": consistency}

    def _corrupted(self, ids: Int[Tensor, "B L"], valid: Bool[Tensor, "B L"]) -> Int[Tensor, "B L"]:
        base = self.base
        corrupted, _ = corrupt_tokens(
            ids,
            valid,
            codebook_size=base.config.codebook_size,
            mask_id=base.mask_id,
            pad_id=base.pad_id,
            share_of=self.options.share_of,
        )
        return corrupted

    @torch.no_grad()
    def _drawn(
        self,
        corrupted: Int[Tensor, "B L"],
        batch: TokenBatch,
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
    ) -> Int[Tensor, "B L"]:
        """Tokens as one step of decoding under control draws them."""
        training = self.model.training
        self.model.eval()
        drawn = drawn_ids(self._logits(corrupted, batch.text, batch, targets, mask))
        self.model.train(training)
        return drawn

    def _logits(
        self,
        corrupted: Int[Tensor, "B L"],
        text: Float[Tensor, "B E"],
        batch: TokenBatch,
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
    ) -> Float[Tensor, "B L K"]:
        base, decoder = self.base, self.decoder
        with torch.no_grad():
            current = decoder(decoder.base_latents(corrupted, batch.valid), batch.frames)
        sequence = base.sequence(base.embed(corrupted), text)
        signal = self.model.signal(targets, mask, current)
        logits: Tensor = self.model(base, sequence, signal, batch.valid)
        return logits.float()

    def _cross_entropy(
        self,
        logits: Float[Tensor, "B L K"],
        corrupted: Int[Tensor, "B L"],
        text: Float[Tensor, "B E"],
        batch: TokenBatch,
        is_drawn: Bool[Tensor, "B"],
    ) -> Float[Tensor, ""]:
        """With the recorded tokens; among drawn ones, with what the frozen model would choose."""
        if not is_drawn.any():
            return token_cross_entropy(logits, batch.ids[..., 0])
        with torch.no_grad():
            free = self.base(self.base.embed(corrupted), text, batch.valid).float().softmax(-1)
            recorded = one_hot(batch.ids[..., 0].clamp(min=0), free.shape[-1]).to(free.dtype)
        natural = torch.where(is_drawn[:, None, None], free, recorded)
        return cross_entropy(logits[batch.valid], natural[batch.valid])

    def _consistency(
        self,
        logits: Float[Tensor, "B L K"],
        batch: TokenBatch,
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        is_drawn: Bool[Tensor, "B"],
    ) -> Float[Tensor, ""]:
        tokenizer, metres = self.decoder.tokenizer, self.decoder.normalizer.skeleton.metres
        latents = mixed_codes(logits, self.decoder.tokenizer.base_codes, self.options.sampling)
        if self.options.finer_layers == "recorded":
            finer = tokenizer.quantizer.lookup(without_base(batch.ids))
            latents = latents + torch.where(is_drawn[:, None, None], 0.0, finer)
        joints = self.decoder(latents * batch.valid[..., None], batch.frames)
        return masked_consistency_loss(joints * metres, targets * metres, mask, norm=self.options.norm)

    @torch.no_grad()
    def _joints(self, features: Tensor) -> Tensor:
        return recover_joints(
            self.decoder.normalizer.denormalize(features), joints=self.decoder.normalizer.skeleton.num_joints
        )


def _build(config: ControlBranchConfig, inputs: StageInputs) -> Recipe:
    decoder = MotionDecoder(*load_tokenizer(inputs.root))
    base = MaskedTransformer.from_pretrained(best_weights(inputs.root, "masked"))
    config = config.for_skeleton(decoder.normalizer.skeleton)
    return ControlRecipe(config, base, decoder, *inputs.token_samplers(), options=inputs.options)


STAGE = Stage(
    "control",
    _build,
    by_size(ControlBranchConfig),
    SETTINGS,
    ("rvq", "masked"),
    network="control",
    options=ControlOptions(),
    samples=clips_with_control,
)
