"""Recipe of TLControl's masked trajectory transformer (equation 3)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import cross_entropy, mse_loss, smooth_l1_loss

from controlmm.data.clip import FeatureClip
from controlmm.models.part_vq_vae import PartVqVae
from controlmm.models.trajectory_transformer import TrajectoryTransformer, TrajectoryTransformerConfig
from controlmm.motion.normalizer import Normalizer
from controlmm.nn.part_quantizer import PartQuantizer
from controlmm.nn.trunk import drop_text
from controlmm.ops import gumbel_straight_through, recover_joints
from controlmm.training.recipe import Recipe
from controlmm.training.settings import TINY, TrainingSettings
from controlmm.training.stage import Stage, StageInputs, by_size, load_part_tokenizer
from controlmm.training.tokens import TokenBatch, TokenSampler
from controlmm.training.trajectory_masks import Masking, given_coordinates

_PAPER_STEPS = 730_000  # 2000 epochs of HumanML3D
_PUBLISHED_WEIGHT, _WEIGHT = 0.001, 0.2  # of the reconstruction; the paper names none
_VALIDATION_BATCH = 50

SETTINGS = {
    # The released rate: constant for 500 epochs, then straight to zero; here half of it after 500 epochs.
    "paper": TrainingSettings(
        steps=_PAPER_STEPS,
        batch_size=64,
        learning_rate=1e-4,
        warmup=0,
        milestones=(_PAPER_STEPS // 4, _PAPER_STEPS // 2),
        gamma=0.5,
        weight_decay=0.01,
        clip_norm=0.0,
        bf16=False,
    ),
    "small": TrainingSettings(steps=2000, batch_size=32, learning_rate=6e-4, warmup=150, weight_decay=0.01),
    "tiny": TINY,
}


@dataclass(frozen=True)
class TrajectoryOptions:
    """What may be chosen beside the network's sizes."""

    # "auto": "paper" for networks of the published form, else "mixed", see `given_coordinates`
    masking: Literal["auto", "mixed", "paper", "released"] = "auto"
    curriculum: int = _PAPER_STEPS  # batches until the published strategies hide most


class TrajectoryRecipe:
    """Cross-entropy of the codes, and reconstruction of the motion decoded from codes drawn by Gumbel noise.

    The second term reaches the logits through the frozen decoder, straight through the drawn codes. The
    published one is a mean squared error with weight 0.001 over clips padded to the longest length, ours
    smooth L1 with weight 0.2 over the frames that there are.
    """

    def __init__(
        self,
        config: TrajectoryTransformerConfig,
        tokenizer: PartVqVae,
        normalizer: Normalizer,
        train_tokens: TokenSampler,
        val_tokens: TokenSampler,
        *,
        options: TrajectoryOptions = TrajectoryOptions(),
    ) -> None:
        self.model = TrajectoryTransformer(config)
        self.tokenizer = tokenizer.eval().requires_grad_(False)
        self.normalizer = normalizer
        self.is_published = config.form == "published"
        automatic: Masking = "paper" if self.is_published else "mixed"
        self.masking: Masking = automatic if options.masking == "auto" else options.masking
        self.curriculum = options.curriculum
        self._train, self._val = train_tokens, val_tokens

    def loss(self, batch_size: int) -> dict[str, Tensor]:
        """Losses of a random batch."""
        self.model.batches_seen += 1
        return self._losses(self._train.sample(batch_size))

    def validate(self) -> dict[str, float]:
        """Losses under masks as in training; ``feedforward``: metres off with all trajectories given."""
        totals: dict[str, float] = {}
        for first in range(0, len(self._val), _VALIDATION_BATCH):
            indices = range(first, min(first + _VALIDATION_BATCH, len(self._val)))
            batch = self._val.whole(indices)
            losses = {**self._losses(batch), "feedforward": self._feedforward_error(batch)}
            for name, value in losses.items():
                totals[name] = totals.get(name, 0.0) + value.item() * len(indices) / len(self._val)
        return {"score": totals["loss"], **totals}

    def describe(self) -> dict[str, Any]:
        """Options of this recipe."""
        return {"stage": "tl-mtt", "masking": self.masking, "curriculum": self.curriculum}

    def _losses(self, batch: TokenBatch) -> dict[str, Tensor]:
        batch = self._placed(batch)
        progress = min(1.0, self.model.batches_seen.item() / self.curriculum)
        parts = self.model.config.num_parts
        given = given_coordinates(self.masking, batch.frames.cpu(), joints=parts, progress=progress)
        text = drop_text(batch.text, self.model.config.text_dropout) if self.model.training else batch.text
        logits = self._logits(batch, given.to(self.model.device), text)
        codes = _clip_cross_entropy(logits, batch.ids)
        latents = draw_codes(logits, self.tokenizer.quantizer, seed=int(torch.randint(2**62, ())))
        reconstruction = self._reconstruction(latents, batch)
        weight = _PUBLISHED_WEIGHT if self.is_published else _WEIGHT
        right = (logits.argmax(-1) == batch.ids)[batch.valid].float().mean()
        return {
            "loss": codes + weight * reconstruction,
            "cross_entropy": codes,
            "reconstruction": reconstruction,
            "accuracy": right,
        }

    def _logits(self, batch: TokenBatch, given: Tensor, text: Tensor) -> Float[Tensor, "B L P K"]:
        targets = self._joints(batch.features)
        mask = torch.zeros_like(targets, dtype=torch.bool)
        mask[:, :, list(self.model.config.joints)] = given
        trajectories, given = self.model.trajectories(targets, mask)
        logits: Tensor = self.model(trajectories, given, text, batch.valid)
        return logits.float()

    def _reconstruction(self, latents: Tensor, batch: TokenBatch) -> Tensor:
        if self.is_published:
            return mse_loss(self.tokenizer.decode(latents).float(), batch.features)
        decoded = self.tokenizer.decode(latents * batch.valid[..., None], batch.frames).float()
        return smooth_l1_loss(decoded[batch.frames], batch.features[batch.frames])

    def _feedforward_error(self, batch: TokenBatch) -> Tensor:
        batch = self._placed(batch)
        given = batch.frames[:, :, None, None].expand(-1, -1, self.model.config.num_parts, 3)
        ids = self._logits(batch, given, batch.text).argmax(-1)
        frames = None if self.is_published else batch.frames
        decoded = self.tokenizer.decode_ids(ids, frames).float()
        distance = (self._joints(decoded) - self._joints(batch.features)).norm(dim=-1)
        steered: Tensor = distance[:, :, list(self.model.config.joints)]
        return steered[batch.frames].mean()

    def _placed(self, batch: TokenBatch) -> TokenBatch:
        """The batch where the network is, in the form that the network sees."""
        self.tokenizer.to(self.model.device)
        batch = batch.to(self.model.device)
        return self._padded(batch) if self.is_published else batch

    def _padded(self, batch: TokenBatch) -> TokenBatch:
        """The batch as the published networks see it: zeros up to the longest length, codes of all of it."""
        longest = self.model.config.max_tokens
        tokens = longest - batch.valid.shape[1]
        frames = tokens * self.tokenizer.downsample
        features = torch.nn.functional.pad(batch.features, (0, 0, 0, frames))
        valid = torch.nn.functional.pad(batch.valid, (0, tokens))
        with torch.no_grad():
            ids = torch.where(valid[..., None], self.tokenizer.encode(features), -1)
        return dataclasses.replace(batch, ids=ids, valid=valid, features=features)

    def _joints(self, features: Float[Tensor, "B T D"]) -> Float[Tensor, "B T J 3"]:
        normalizer = self.normalizer.to(features.device)
        return recover_joints(normalizer.denormalize(features), joints=normalizer.skeleton.num_joints)


def draw_codes(
    logits: Float[Tensor, "B L P K"], quantizer: PartQuantizer, *, seed: int
) -> Float[Tensor, "B L C"]:
    """Codes of every part drawn from ``logits``, side by side; the gradient passes straight through."""
    drawn = [
        gumbel_straight_through(part, quantizer.book(index).codes, seed=seed + index)[0]
        for index, part in enumerate(logits.unbind(2))
    ]
    return torch.cat(drawn, dim=-1)


def trajectory_statistics(
    clips: Sequence[FeatureClip], normalizer: Normalizer, joints: Sequence[int]
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Mean and standard deviation of the coordinates of ``joints`` over all frames of all clips."""
    count = normalizer.skeleton.num_joints
    positions = [recover_joints(clip.features[None], joints=count)[0][:, list(joints)] for clip in clips]
    every = torch.cat(positions).flatten(0, 1).double()
    return every.mean(0).float(), every.std(0, correction=0).float()


def _clip_cross_entropy(logits: Float[Tensor, "B L P K"], ids: Int[Tensor, "B L P"]) -> Float[Tensor, ""]:
    """Mean over each clip's own codes, then over the clips (-1 is padding)."""
    entropy = cross_entropy(logits.flatten(0, 2), ids.flatten(), ignore_index=-1, reduction="none")
    is_code = (ids >= 0).flatten(1)
    return (entropy.view(is_code.shape).sum(1) / is_code.sum(1)).mean()


def _build(config: TrajectoryTransformerConfig, inputs: StageInputs) -> Recipe:
    assert inputs.text_encoder is not None  # the stage uses text
    tokenizer, normalizer = load_part_tokenizer(inputs.root)
    config = config.for_text(inputs.text_encoder.dim).for_skeleton(normalizer.skeleton)
    recipe = TrajectoryRecipe(
        config, tokenizer, normalizer, *inputs.token_samplers(tokenizer), options=inputs.options
    )
    mean, std = trajectory_statistics(inputs.train_clips, normalizer, config.joints)
    recipe.model.trajectory_mean.copy_(mean)
    recipe.model.trajectory_std.copy_(std)
    return recipe


STAGE = Stage(
    "tl-mtt",
    _build,
    by_size(TrajectoryTransformerConfig),
    SETTINGS,
    ("tl-vq",),
    system="tlcontrol",
    network="transformer",
    options=TrajectoryOptions(),
)
