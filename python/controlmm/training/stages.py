"""The four stages of ControlMM's training, each a run folder below one root."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from controlmm.data.clip import FeatureClip
from controlmm.data.folder import MotionFolder
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.models.control_branch import ControlBranchConfig
from controlmm.models.masked_transformer import MaskedTransformer, MaskedTransformerConfig
from controlmm.models.residual_transformer import ResidualTransformerConfig
from controlmm.models.rvq_vae import RvqVae, RvqVaeConfig
from controlmm.motion.normalizer import Normalizer
from controlmm.text import TextEncoder, encode_all
from controlmm.training import control, masked, residual, rvq
from controlmm.training.loop import Recipe, train
from controlmm.training.tokens import MIN_FRAMES, TokenSampler

STAGES = ("rvq", "masked", "residual", "control")
SIZES = ("small", "paper", "tiny")
NORMALIZER_FILE = "normalizer.safetensors"

_SETTINGS = {
    "rvq": rvq.SETTINGS,
    "masked": masked.SETTINGS,
    "residual": residual.SETTINGS,
    "control": control.SETTINGS,
}
_CONFIGS: dict[str, type] = {
    "rvq": RvqVaeConfig,
    "masked": MaskedTransformerConfig,
    "residual": ResidualTransformerConfig,
    "control": ControlBranchConfig,
}


def train_stage(
    stage: str,
    *,
    data: str | Path,
    size: str,
    root: str | Path,
    text_encoder: TextEncoder | None = None,
    changes: dict[str, Any] | None = None,
    progress: bool = True,
) -> Path:
    """Train one stage into ``root/<stage>`` or go on where it was stopped. Returns the run folder.

    Args:
        stage: ``rvq``, then ``masked``, then ``residual`` and ``control``; each needs the ones before it in
            ``root``.
        data: A HumanML3D-style folder with train and val lists.
        size: ``small``, ``paper`` or ``tiny``.
        root: Folder of all stages of one model.
        text_encoder: Needed by every stage but ``rvq``; its features are cached beside the data.
        changes: Fields of :class:`TrainingSettings` to override.
        progress: Show progress bars.

    Raises:
        FileNotFoundError: If the data or an earlier stage is missing.
        ValueError: If a name is unknown, the data is unusable, or ``root/<stage>`` holds another run.
    """
    if stage not in STAGES or size not in SIZES:
        raise ValueError(
            f"Unknown stage or size {stage!r}, {size!r}. "
            f"Stages: {', '.join(STAGES)}; sizes: {', '.join(SIZES)}."
        )
    root = Path(root)
    settings = replace(_SETTINGS[stage][size], **(changes or {}))
    folder = MotionFolder(data)
    train_clips = list(folder.clips("train", progress=progress))
    val_clips = list(folder.clips("val", progress=progress))
    torch.manual_seed(settings.seed)  # fresh weights are a function of the seed
    config = getattr(_CONFIGS[stage], size)()
    if stage == "rvq":
        recipe = _rvq_recipe(config, root, train_clips, val_clips)
    else:
        if text_encoder is None:
            raise ValueError(f"`text_encoder` is needed to train {stage!r}.")
        recipe = _token_recipe(stage, config, root, folder, train_clips, val_clips, text_encoder, progress)
    run = root / stage
    train(_Described(recipe, size, train_clips, val_clips), settings, run, progress=progress)
    return run


def load_tokenizer(root: str | Path) -> tuple[RvqVae, Normalizer]:
    """The trained tokenizer of ``root`` and its feature statistics.

    Raises:
        FileNotFoundError: If the stage ``rvq`` is not trained yet.
    """
    root = Path(root)
    _need(root, "rvq")
    return RvqVae.from_pretrained(root / "rvq" / "best"), Normalizer.load(root / NORMALIZER_FILE)


def _rvq_recipe(
    config: RvqVaeConfig, root: Path, train_clips: Sequence[FeatureClip], val_clips: Sequence[FeatureClip]
) -> Recipe:
    if not train_clips:
        raise ValueError("The training split has no readable clip.")
    normalizer = Normalizer.fit(clip.features for clip in train_clips)
    root.mkdir(parents=True, exist_ok=True)
    normalizer.save(root / NORMALIZER_FILE)
    config = config.for_features(normalizer.skeleton.feature_dim)
    return rvq.RvqRecipe(config, normalizer, train_clips, val_clips)


def _token_recipe(
    stage: str,
    config: Any,
    root: Path,
    folder: MotionFolder,
    train_clips: Sequence[FeatureClip],
    val_clips: Sequence[FeatureClip],
    text_encoder: TextEncoder,
    progress: bool,
) -> Recipe:
    tokenizer, normalizer = load_tokenizer(root)
    texts = sorted({c.text for clips in (train_clips, val_clips) for clip in clips for c in clip.captions})
    cache = folder.path / f"text_{text_encoder.name}.safetensors"
    features = dict(zip(texts, encode_all(texts, text_encoder, cache, progress=progress), strict=True))

    def tokens(clips: Sequence[FeatureClip]) -> TokenSampler:
        # KIT-ML's clips are at 12.5 fps, so its shortest are shorter.
        shortest = MIN_FRAMES if normalizer.skeleton.unit == "m" else 24
        return TokenSampler(clips, normalizer, tokenizer, features, progress=progress, min_frames=shortest)

    if stage == "control":
        _need(root, "masked")
        base = MaskedTransformer.from_pretrained(root / "masked" / "best")
        decoder = MotionDecoder(tokenizer, normalizer)
        config = config.for_skeleton(normalizer.skeleton)
        return control.ControlRecipe(config, base, decoder, tokens(train_clips), tokens(val_clips))
    recipes: dict[str, Callable[..., Recipe]] = {
        "masked": masked.MaskedRecipe,
        "residual": residual.ResidualRecipe,
    }
    return recipes[stage](config.for_text(text_encoder.dim), tokens(train_clips), tokens(val_clips))


class _Described:
    """A recipe that also says which clips it was given, so that a run names its data."""

    def __init__(
        self, recipe: Recipe, size: str, train_clips: Sequence[FeatureClip], val_clips: Sequence[FeatureClip]
    ) -> None:
        self._recipe, self._size = recipe, size
        self._data = {
            name: {"clips": len(clips), "sha256": _hash(clips)}
            for name, clips in (("train", train_clips), ("val", val_clips))
        }
        self.model, self.loss, self.validate = recipe.model, recipe.loss, recipe.validate

    def describe(self) -> dict[str, Any]:
        return {**self._recipe.describe(), "size": self._size, "data": self._data}


def _hash(clips: Sequence[FeatureClip]) -> str:
    digest = hashlib.sha256()
    for clip in clips:
        digest.update(clip.id.encode())
        digest.update(clip.features.numpy().tobytes())
    return digest.hexdigest()


def _need(root: Path, stage: str) -> None:
    if not (root / stage / "best").is_dir():
        raise FileNotFoundError(
            f"{root / stage} holds no trained stage. Run `controlmm train {stage}` with the same --out first."
        )
