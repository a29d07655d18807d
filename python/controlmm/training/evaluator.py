"""Recipe of the in-project evaluator: motions and sentences that belong together come near."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import cross_entropy

from controlmm.models.motion_text_matcher import MatcherConfig, MotionTextMatcher
from controlmm.motion.normalizer import Normalizer
from controlmm.training.matching_pairs import PairBatch, PairSampler
from controlmm.training.settings import TINY, TrainingSettings
from controlmm.training.stage import Stage, StageInputs, by_size

SETTINGS = {
    "paper": TrainingSettings(
        steps=100_000, batch_size=128, learning_rate=2e-4, weight_decay=0.01, bf16=False
    ),
    "small": TrainingSettings(
        steps=600, batch_size=96, learning_rate=1e-3, warmup=60, weight_decay=0.05, validate_every=100
    ),
    "tiny": dataclasses.replace(TINY, batch_size=4),
}
SCORED_KINDS = ("annotator", "written", "kinematic")  # sentences of test that hardly occur in train
_SHARPNESS = 0.14  # times the scalar product (at most 100): a temperature of 0.07 for unit vectors
_GROUP = 32  # of the validation's retrieval, as in the papers
_VALIDATION_ROUNDS = 4  # each with other captions, crops and groups


class EvaluatorRecipe:
    """Symmetric cross-entropy over a batch (InfoNCE) without the pairs that may belong together too."""

    def __init__(
        self, config: MatcherConfig, normalizer: Normalizer, train_pairs: PairSampler, val_pairs: PairSampler
    ) -> None:
        self.model = MotionTextMatcher(config, normalizer)
        self._train, self._val = train_pairs, val_pairs

    def loss(self, batch_size: int) -> dict[str, Tensor]:
        """Loss of a random batch and how often the right motion comes first."""
        batch = self._train.sample(batch_size)
        scores = self._scores(batch)
        first = (scores.argmax(1) == torch.arange(len(scores), device=scores.device)).float().mean()
        return {"loss": contrastive_loss(scores, batch.is_negative), "top1": first}

    def validate(self) -> dict[str, float]:
        """R-precision on the validation clips; ``score`` is the share of misses, averaged over top 1 to 3."""
        group = min(_GROUP, len(self._val))
        hits, losses = [], []
        for _ in range(_VALIDATION_ROUNDS):
            for indices in self._val.shuffled(group):
                batch = self._val.batch(indices)
                scores = self._scores(batch)
                rank = (scores > scores.diagonal()[:, None]).sum(1)
                hits.append(torch.stack([(rank < k).float().mean() for k in (1, 2, 3)]))
                losses.append(contrastive_loss(scores, batch.is_negative))
        r1, r2, r3 = (share.item() for share in torch.stack(hits).mean(0))
        return {
            "score": 1 - (r1 + r2 + r3) / 3, "r1": r1, "r2": r2, "r3": r3,
            "loss": torch.stack(losses).mean().item(),
        }  # fmt: skip

    def describe(self) -> dict[str, Any]:
        """Options of this recipe."""
        return {"stage": "evaluator", "network": dataclasses.asdict(self.model.config)}

    def _scores(self, batch: PairBatch) -> Float[Tensor, "B B"]:
        """Sharpened cosines, sentence by motion."""
        device = self.model.device
        motions = self.model.embed_motions(batch.features.to(device), batch.lengths.to(device))
        return _SHARPNESS * self.model.embed_texts(batch.text.to(device)) @ motions.T


def contrastive_loss(scores: Float[Tensor, "B B"], is_negative: Bool[Tensor, "B B"]) -> Float[Tensor, ""]:
    """Mean of the text-to-motion and the motion-to-text cross-entropy over the sure negatives."""
    own = torch.eye(len(scores), dtype=torch.bool, device=scores.device)
    scores = scores.masked_fill(~(is_negative.to(scores.device) | own), -torch.inf)
    target = torch.arange(len(scores), device=scores.device)
    return (cross_entropy(scores, target) + cross_entropy(scores.T, target)) / 2


def _build(config: MatcherConfig, inputs: StageInputs) -> EvaluatorRecipe:
    assert inputs.text_encoder is not None  # the stage uses text
    normalizer = Normalizer.fit((clip.features for clip in inputs.train_clips), root_contact_bias=1.0)
    texts = inputs.text_features()
    captions = (caption for clip in inputs.val_clips for caption in clip.captions)
    scored = SCORED_KINDS if any(caption.kind in SCORED_KINDS for caption in captions) else None
    return EvaluatorRecipe(
        config.for_data(normalizer.skeleton.feature_dim, inputs.text_encoder.config()),
        normalizer,
        PairSampler(inputs.train_clips, texts),
        PairSampler(inputs.val_clips, texts, kinds=scored),
    )


STAGE = Stage("evaluator", _build, by_size(MatcherConfig), SETTINGS)
