"""What a training stage is, and what the builder of its recipe may ask for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.data.clip import FEWEST_FRAMES, FeatureClip
from controlmm.data.folder import MotionFolder
from controlmm.models.part_vq_vae import PartVqVae
from controlmm.models.rvq_vae import RvqVae
from controlmm.models.tokenizer import MotionTokenizer
from controlmm.motion.normalizer import ROOT_CONTACT_BIAS, Normalizer
from controlmm.text import TextEncoder, encode_all
from controlmm.training.augmentation import Augmentation, augmented
from controlmm.training.level_ground import ClipSelection, select
from controlmm.training.recipe import Recipe, Sample
from controlmm.training.settings import TrainingSettings
from controlmm.training.tokens import TokenSampler

NORMALIZER_FILE = "normalizer.safetensors"
SIZES = ("small", "paper", "tiny")
_REFINERS = {"rvq": "rvq-decoder", "tl-vq": "tl-decoder"}  # of the tokenizers' decoders
_Tokenizer = TypeVar("_Tokenizer", bound=MotionTokenizer)


@dataclass(frozen=True)
class StageInputs:
    """Data and earlier stages, as the builder of a recipe sees them."""

    root: Path  # of all stages of one model
    folder: MotionFolder
    text_encoder: TextEncoder | None = None  # set for stages that use text
    options: Any = None  # the stage's own, see `Stage.options`
    augmentation: Augmentation = field(default_factory=Augmentation)
    selection: ClipSelection = field(default_factory=ClipSelection)
    progress: bool = True
    start: Path | None = None  # folder of the weights that the network starts from
    writes: bool = True  # whether this process may write into the root; one of those that train together may

    @cached_property
    def recorded_clips(self) -> list[FeatureClip]:
        """The clips of the training split as they were recorded, those that the selection takes."""
        return select(list(self.folder.clips("train", progress=self.progress)), self.selection)

    @cached_property
    def train_clips(self) -> list[FeatureClip]:
        """What to train on: the recorded clips, and those that augmentation makes of them."""
        return self.recorded_clips + augmented(self.recorded_clips, self.augmentation)

    @cached_property
    def val_clips(self) -> list[FeatureClip]:
        """The clips of the validation split."""
        return list(self.folder.clips("val", progress=self.progress))

    @property
    def splits(self) -> dict[str, list[FeatureClip]]:
        """The recorded clips of both, by name."""
        return {"train": self.recorded_clips, "val": self.val_clips}

    def text_features(self) -> dict[str, Float[Tensor, "E"]]:
        """The text encoder's pooled vector of every caption; cached beside the data."""
        assert self.text_encoder is not None  # `train_stage` asks for it
        clips = self.train_clips + self.val_clips
        texts = sorted({caption.text for clip in clips for caption in clip.captions})
        cache = self.folder.path / f"text_{self.text_encoder.name}.safetensors"
        features = encode_all(texts, self.text_encoder, cache, progress=self.progress)
        return dict(zip(texts, features, strict=True))

    def token_samplers(self, tokenizer: MotionTokenizer | None = None) -> tuple[TokenSampler, TokenSampler]:
        """Training and validation clips as tokens, by default of the stage ``rvq``, with their captions."""
        tokenizer = load_tokenizer(self.root)[0] if tokenizer is None else tokenizer
        normalizer = Normalizer.load(self.root / NORMALIZER_FILE)
        features = self.text_features()
        shortest = FEWEST_FRAMES[normalizer.skeleton.unit]
        train, val = (
            TokenSampler(clips, normalizer, tokenizer, features, progress=self.progress, min_frames=shortest)
            for clips in (self.train_clips, self.val_clips)
        )
        return train, val


@dataclass(frozen=True)
class Stage:
    """One network's training: its sizes, and how its recipe is made of data and earlier stages.

    A module of :mod:`controlmm.training` that trains a network offers one as ``STAGE``; the table in
    ``registry.py`` names the module.
    """

    name: str  # also the run folder's
    build: Callable[[Any, StageInputs], Recipe]  # (network configuration, inputs)
    configs: Mapping[str, Any]  # network configuration by size
    settings: Mapping[str, TrainingSettings]  # by size
    needs: tuple[str, ...] = ()  # stages that must be trained before, in the same root
    system: str = field(default="controlmm", kw_only=True)  # the kind of whole model that it is a part of
    network: str | None = field(default=None, kw_only=True)  # its folder in the folder of a whole model
    uses_text: bool = field(default=True, kw_only=True)
    options: Any = field(default=None, kw_only=True)  # a frozen dataclass: the recipe's own, with defaults
    samples: Callable[[Recipe, StageInputs], Sequence[Sample]] | None = field(default=None, kw_only=True)
    starts_from_weights: bool = field(default=True, kw_only=True)  # whether a model's weights are enough


def by_size(config_class: Any) -> dict[str, Any]:
    """The configurations that a network's class offers under the names of ``SIZES``."""
    return {size: getattr(config_class, size)() for size in SIZES}


def best_weights(root: Path, stage: str) -> Path:
    """Folder of the best weights of a trained stage.

    Raises:
        FileNotFoundError: If the stage is not trained yet.
    """
    folder = root / stage / "best"
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{root / stage} holds no trained stage. Run `controlmm train {stage}` with the same --out first."
        )
    return folder


def fit_normalizer(inputs: StageInputs, *, root_contact_bias: float = ROOT_CONTACT_BIAS) -> Normalizer:
    """Feature statistics of the training split, which the first stage of a model writes into its root.

    Raises:
        ValueError: If the training split is empty.
    """
    if not inputs.recorded_clips:
        raise ValueError("The training split has no readable clip.")
    normalizer = Normalizer.fit(
        (clip.features for clip in inputs.recorded_clips), root_contact_bias=root_contact_bias
    )
    if inputs.writes:
        inputs.root.mkdir(parents=True, exist_ok=True)
        normalizer.save(inputs.root / NORMALIZER_FILE)
    return normalizer


def load_tokenizer(root: str | Path) -> tuple[RvqVae, Normalizer]:
    """The trained tokenizer of ``root``, with its refined decoder if there is one, and the statistics.

    Raises:
        FileNotFoundError: If the stage ``rvq`` is not trained yet.
        ValueError: If the refined decoder belongs to another tokenizer.
    """
    return _load(RvqVae, "rvq", Path(root))


def load_part_tokenizer(root: str | Path) -> tuple[PartVqVae, Normalizer]:
    """As :func:`load_tokenizer`, of TLControl: the stage ``tl-vq``, refined by ``tl-decoder``."""
    return _load(PartVqVae, "tl-vq", Path(root))


def _load(network: type[_Tokenizer], stage: str, root: Path) -> tuple[_Tokenizer, Normalizer]:
    tokenizer = network.from_pretrained(best_weights(root, stage))
    normalizer = Normalizer.load(root / NORMALIZER_FILE)
    refiner = tokenizer_stage(root, stage)
    if refiner == stage:
        return tokenizer, normalizer
    refined = network.from_pretrained(best_weights(root, refiner))
    if not have_same_codes(refined, tokenizer):
        raise ValueError(
            f"{root / refiner} refines another tokenizer than {root / stage}. Remove it, or train it again."
        )
    return refined, normalizer


def have_same_codes(first: MotionTokenizer, second: MotionTokenizer) -> bool:
    """Whether a token means the same to both tokenizers, whatever their decoders see beyond a clip."""
    alike = replace(first.config, decoder_ends=second.config.decoder_ends)
    return alike == second.config and all(
        torch.equal(code, other) for code, other in zip(_codes(first), _codes(second), strict=True)
    )


def _codes(tokenizer: MotionTokenizer) -> list[Tensor]:
    state = tokenizer.quantizer.state_dict()
    return [state[name] for name in state if name.rpartition(".")[2] not in tokenizer.training_state]


def tokenizer_stage(root: Path, stage: str = "rvq") -> str:
    """The stage that the tokenizer of ``root`` comes from: ``stage``, or the one that refined its decoder."""
    refiner = _REFINERS[stage]
    return refiner if (root / refiner / "best").is_dir() else stage
