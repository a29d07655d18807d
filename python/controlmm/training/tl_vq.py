"""Recipe of TLControl's part-based motion tokenizer, and of the unsplit one of its ablation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import mse_loss, smooth_l1_loss

from controlmm.data.clip import FeatureClip
from controlmm.models.part_vq_vae import PartVqVae, PartVqVaeConfig
from controlmm.motion.layout import feature_layout
from controlmm.motion.normalizer import Normalizer
from controlmm.ops import recover_joints
from controlmm.training import rvq
from controlmm.training.recipe import Recipe
from controlmm.training.rvq import reconstruction_errors
from controlmm.training.samples import rebuilt_clips
from controlmm.training.settings import TINY, TrainingSettings
from controlmm.training.stage import Stage, StageInputs, by_size, fit_normalizer
from controlmm.training.windows import PaddedClipSampler, WindowSampler

PADDED_FRAMES = 196  # of the published training: whole clips, zeros behind them
_POSITION_WEIGHT, _COMMITMENT_WEIGHT = 0.5, 0.02
_PAPER_STEPS = 365_000
_PUBLISHED_COMMITMENT = 0.001  # times the sum over the parts

SETTINGS = {
    # 1000 epochs of HumanML3D at a constant rate, as the released script has it; the paper ends at 1e-7.
    "paper": TrainingSettings(
        steps=_PAPER_STEPS,
        batch_size=64,
        learning_rate=1e-4,
        warmup=0,
        milestones=(_PAPER_STEPS,),
        clip_norm=0.0,
        bf16=False,
    ),
    "small": TrainingSettings(steps=2400, batch_size=64, learning_rate=6e-4, warmup=200),
    "tiny": TINY,
}


class PartVqRecipe:
    """Reconstruction and commitment; for networks with the published latent norm, the published recipe.

    Published: mean squared error over whole clips padded with zeros to 196 frames, padding included, plus
    the commitment. Ours: smooth L1 over windows of 64 frames, a second time on joint positions, and the
    global joints in metres, which show how errors of the root velocity add up.
    """

    def __init__(
        self,
        config: PartVqVaeConfig,
        normalizer: Normalizer,
        train_clips: Sequence[FeatureClip],
        val_clips: Sequence[FeatureClip],
    ) -> None:
        self.model = PartVqVae(config)
        self.normalizer = normalizer
        self.is_published = config.latent_norm == "clip"
        self._samples = (
            PaddedClipSampler(train_clips, normalizer, length=PADDED_FRAMES)
            if self.is_published
            else WindowSampler(train_clips, normalizer, length=rvq.WINDOW)
        )
        self._val_clips = [clip for clip in val_clips if len(clip.features) >= config.downsample]
        if not self._val_clips:
            raise ValueError("The validation split has no readable clip. List some names in val.txt.")
        self._positions = feature_layout(normalizer.skeleton).local_positions

    def loss(self, batch_size: int) -> dict[str, Tensor]:
        """Losses of a random batch."""
        target = self._samples.sample(batch_size).to(self.model.device)
        decoded, quantized = self.model(target)
        decoded = decoded.float()
        losses = self._published(decoded, target) if self.is_published else self._ours(decoded, target)
        commitment = quantized.commitment
        parts = self.model.config.num_parts
        weight = parts * _PUBLISHED_COMMITMENT if self.is_published else _COMMITMENT_WEIGHT
        losses["loss"] = losses["loss"] + weight * commitment
        return {**losses, "commitment": commitment, "perplexity": quantized.perplexity}

    def validate(self) -> dict[str, float]:
        """Joint errors over whole clips, see :func:`controlmm.training.rvq.reconstruction_errors`."""
        return reconstruction_errors(self.model, self.normalizer, self._val_clips)

    def describe(self) -> dict[str, Any]:
        """Options of this recipe."""
        return {"stage": "tl-vq" if self.model.config.is_split else "tl-unsplit"}

    def _published(self, decoded: Tensor, target: Tensor) -> dict[str, Tensor]:
        reconstruction = mse_loss(decoded, target)
        return {"loss": reconstruction, "reconstruction": reconstruction}

    def _ours(self, decoded: Tensor, target: Tensor) -> dict[str, Tensor]:
        reconstruction = smooth_l1_loss(decoded, target)
        positions = smooth_l1_loss(decoded[..., self._positions], target[..., self._positions])
        joints = (self._joints(decoded) - self._joints(target)).norm(dim=-1).mean()
        loss = reconstruction + _POSITION_WEIGHT * positions + joints
        return {"loss": loss, "reconstruction": reconstruction, "positions": positions, "joints": joints}

    def _joints(self, features: Float[Tensor, "B T D"]) -> Float[Tensor, "B T J 3"]:
        normalizer = self.normalizer.to(features.device)
        return recover_joints(normalizer.denormalize(features), joints=normalizer.skeleton.num_joints)


def _build(config: PartVqVaeConfig, inputs: StageInputs) -> Recipe:
    normalizer = fit_normalizer(inputs)
    config = config.for_features(normalizer.skeleton.feature_dim)
    return PartVqRecipe(config, normalizer, inputs.train_clips, inputs.val_clips)


STAGE = Stage(
    "tl-vq",
    _build,
    by_size(PartVqVaeConfig),
    SETTINGS,
    system="tlcontrol",
    network="tokenizer",
    uses_text=False,
    starts_from_weights=False,
    samples=rebuilt_clips,
)
