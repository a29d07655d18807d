"""Recipe of the length estimator: which lengths go with a sentence."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import cross_entropy

from controlmm.data.clip import FEWEST_FRAMES, MOST_FRAMES, FeatureClip
from controlmm.models.length_estimator import LengthEstimator, LengthEstimatorConfig
from controlmm.motion.skeleton import skeleton_of_width
from controlmm.training.recipe import Recipe
from controlmm.training.settings import TrainingSettings
from controlmm.training.stage import Stage, StageInputs, by_size
from controlmm.training.windows import source_weights

_FRAMES_A_TOKEN = 4
_PAPER = TrainingSettings(
    steps=110_000,  # 300 epochs of HumanML3D
    batch_size=64,
    learning_rate=1e-4,
    warmup=0,
    milestones=(110_000,),  # a constant rate
    betas=(0.9, 0.999),
    clip_norm=0.5,
    bf16=False,
)
SETTINGS = {
    "paper": _PAPER,
    "small": dataclasses.replace(_PAPER, steps=3000, learning_rate=5e-4, milestones=(), warmup=100),
    "tiny": dataclasses.replace(
        _PAPER, steps=20, batch_size=8, learning_rate=1e-3, validate_every=10, checkpoint_every=5
    ),
}


@dataclasses.dataclass(frozen=True)
class LengthPairs:
    """Sentences and the numbers of tokens of what they speak of, one row a caption."""

    text: Float[Tensor, "N E"]
    tokens: Int[Tensor, "N"]
    weights: Float[Tensor, "N"]  # how often a row is drawn: sources balanced, captions of a clip share one

    @classmethod
    def of_clips(
        cls, clips: Sequence[FeatureClip], text_features: Mapping[str, Float[Tensor, "E"]], *, most: int
    ) -> LengthPairs:
        """Every caption of a clip, or of a part of one, as long as those that the transformers learn from.

        Args:
            clips: With captions.
            text_features: Vector of every caption.
            most: Longest length in tokens; longer ones count as this long, as they are cut in training.

        Raises:
            ValueError: If no caption belongs to a usable length.
        """
        rows = []
        for clip in clips:
            skeleton = skeleton_of_width(clip.features.shape[1])
            for caption in clip.captions:
                frames = len(clip.features)
                if caption.is_partial:
                    frames = min(int(caption.end * skeleton.fps), frames) - int(caption.start * skeleton.fps)
                if FEWEST_FRAMES[skeleton.unit] <= frames <= MOST_FRAMES:
                    count = min(frames // _FRAMES_A_TOKEN, most)
                    rows.append((caption.text, count, clip.source, 1 / len(clip.captions)))
        if not rows:
            raise ValueError("No clip has a caption and a usable length.")
        texts, tokens, sources, shares = zip(*rows, strict=True)
        return cls(
            torch.stack([text_features[text] for text in texts]),
            torch.tensor(tokens),
            source_weights(sources, shares),
        )


class LengthRecipe:
    """Cross-entropy of the token count, given the text."""

    def __init__(self, config: LengthEstimatorConfig, train: LengthPairs, val: LengthPairs) -> None:
        self.model = LengthEstimator(config)
        self._train, self._val = train, val

    def loss(self, batch_size: int) -> dict[str, Tensor]:
        """Loss of a random batch of captions."""
        rows = torch.multinomial(self._train.weights, batch_size, replacement=True)
        return self._losses(self._train, rows)

    def validate(self) -> dict[str, float]:
        """Loss on all validation captions, and the mean distance of the expected length in frames."""
        losses = self._losses(self._val, torch.arange(len(self._val.tokens)))
        values = {name: value.item() for name, value in losses.items()}
        return {"score": values["loss"], **values}

    def describe(self) -> dict[str, Any]:
        """Options of this recipe."""
        return {"stage": "length"}

    def _losses(self, pairs: LengthPairs, rows: Int[Tensor, "B"]) -> dict[str, Tensor]:
        device = self.model.device
        logits = self.model(pairs.text[rows].to(device)).float()
        tokens = pairs.tokens[rows].to(device)
        expected = logits.softmax(-1) @ torch.arange(logits.shape[1], dtype=logits.dtype, device=device)
        return {
            "loss": cross_entropy(logits, tokens),
            "frames_off": (expected - tokens).abs().mean() * _FRAMES_A_TOKEN,
        }


def _build(config: LengthEstimatorConfig, inputs: StageInputs) -> Recipe:
    assert inputs.text_encoder is not None  # the stage uses text
    config = config.for_text(inputs.text_encoder.dim)
    features = inputs.text_features()
    train, val = (
        LengthPairs.of_clips(clips, features, most=config.classes - 1)
        for clips in (inputs.train_clips, inputs.val_clips)
    )
    return LengthRecipe(config, train, val)


STAGE = Stage("length", _build, by_size(LengthEstimatorConfig), SETTINGS, network="length")
