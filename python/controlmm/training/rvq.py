"""Recipe of the motion tokenizer (RVQ-VAE)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import l1_loss, smooth_l1_loss

from controlmm.data.clip import FeatureClip
from controlmm.models.rvq_vae import RvqVae, RvqVaeConfig
from controlmm.models.tokenizer import MotionTokenizer
from controlmm.motion.layout import feature_layout
from controlmm.motion.normalizer import ROOT_CONTACT_BIAS, Normalizer
from controlmm.ops import recover_joints
from controlmm.training.recipe import Recipe
from controlmm.training.samples import rebuilt_clips
from controlmm.training.settings import TINY, TrainingSettings
from controlmm.training.stage import Stage, StageInputs, by_size, fit_normalizer
from controlmm.training.windows import WindowSampler

WINDOW = 64  # frames
POSITION_WEIGHT = 0.5
_COMMITMENT_WEIGHT = 0.02

SETTINGS = {
    "paper": TrainingSettings(
        steps=400_000, batch_size=256, milestones=(150_000, 250_000), gamma=0.05, clip_norm=0.0, bf16=False
    ),
    "small": TrainingSettings(steps=6000, batch_size=128, learning_rate=6e-4, warmup=200),
    "tiny": TINY,
}


@dataclass(frozen=True)
class RvqOptions:
    """What the tokenizer's recipe can do in different ways."""

    # Weight of the recovered joints' error in metres, which is ours: errors of the root velocity add up along
    # the path, and only those joints show it. 0 gives the published loss.
    joint_weight: float = 1.0
    reconstruction: Literal["smooth_l1", "l1"] = "smooth_l1"
    root_contact_bias: float = ROOT_CONTACT_BIAS  # published option: 5, but applied twice, so 25

    def __post_init__(self) -> None:
        if not self.joint_weight >= 0 or not self.root_contact_bias > 0:
            raise ValueError(
                "`joint_weight` must not be negative and `root_contact_bias` must be positive, got "
                f"{self.joint_weight} and {self.root_contact_bias}."
            )


class RvqRecipe:
    """Reconstruction, a second time on joint positions, commitment, and global joints in metres."""

    def __init__(
        self,
        config: RvqVaeConfig,
        normalizer: Normalizer,
        train_clips: Sequence[FeatureClip],
        val_clips: Sequence[FeatureClip],
        *,
        options: RvqOptions = RvqOptions(),
    ) -> None:
        self.model = RvqVae(config)
        self.normalizer = normalizer
        self.joint_weight = options.joint_weight
        self._distance = smooth_l1_loss if options.reconstruction == "smooth_l1" else l1_loss
        self._windows = WindowSampler(train_clips, normalizer, length=WINDOW)
        self._val_clips = [clip for clip in val_clips if len(clip.features) >= config.downsample]
        if not self._val_clips:
            raise ValueError("The validation split has no readable clip. List some names in val.txt.")
        self._positions = feature_layout(normalizer.skeleton).local_positions

    def loss(self, batch_size: int) -> dict[str, Tensor]:
        """Losses of a random batch of windows."""
        target = self._windows.sample(batch_size).to(self.model.device)
        decoded, quantized = self.model(target)
        decoded = decoded.float()
        reconstruction = self._distance(decoded, target)
        positions = self._distance(decoded[..., self._positions], target[..., self._positions])
        loss = reconstruction + POSITION_WEIGHT * positions + _COMMITMENT_WEIGHT * quantized.commitment
        losses = {
            "reconstruction": reconstruction,
            "positions": positions,
            "commitment": quantized.commitment,
        }
        if self.joint_weight:
            joints = (self._joints(decoded) - self._joints(target)).norm(dim=-1).mean()
            losses["joints"] = joints
            loss = loss + self.joint_weight * joints
        return {"loss": loss, "perplexity": quantized.perplexity, **losses}

    def validate(self) -> dict[str, float]:
        """Joint errors over whole clips, see :func:`reconstruction_errors`."""
        return reconstruction_errors(self.model, self.normalizer, self._val_clips)

    def describe(self) -> dict[str, Any]:
        """Options of this recipe."""
        return {"stage": "rvq", "joint_weight": self.joint_weight, "window": WINDOW}

    def _joints(self, features: Float[Tensor, "B T D"]) -> Float[Tensor, "B T J 3"]:
        normalizer = self.normalizer.to(features.device)
        return recover_joints(normalizer.denormalize(features), joints=normalizer.skeleton.num_joints)


def reconstruction_errors(
    model: MotionTokenizer, normalizer: Normalizer, clips: Sequence[FeatureClip]
) -> dict[str, float]:
    """Mean joint position error of encode -> quantise -> decode over whole clips (each cut to whole tokens).

    Returns ``global`` and ``local`` (relative to the root, turned into its heading) in metres, averaged over
    frames and joints, then clips; ``score``, the local error plus a tenth of the global one; and for every
    layer ``perplexity_0``, ...: how many codes are in use, as e to the entropy of their shares.
    """
    errors, ids = [], []
    normalizer = normalizer.to(model.device)
    joints = normalizer.skeleton.num_joints
    for clip in clips:
        frames = len(clip.features) // model.config.downsample * model.config.downsample
        target = clip.features[None, :frames].to(model.device)
        decoded, quantized = model(normalizer.normalize(target))
        decoded = normalizer.denormalize(decoded.float())
        ids.append(quantized.ids[0])
        global_error = (recover_joints(decoded, joints=joints) - recover_joints(target, joints=joints)).norm(
            dim=-1
        )
        local_error = (decoded - target)[..., 4 : 4 + 3 * (joints - 1)].unflatten(-1, (-1, 3)).norm(dim=-1)
        errors.append((global_error.mean().item(), local_error.mean().item()))
    mean = torch.tensor(errors).mean(0)
    score = (mean[1] + 0.1 * mean[0]).item()
    return {
        "global": mean[0].item(),
        "local": mean[1].item(),
        "score": score,
        **layer_perplexities(torch.cat(ids)),
    }


def layer_perplexities(ids: Int[Tensor, "N Q"]) -> dict[str, float]:
    """``perplexity_q`` of each layer's codes: 1 when one code serves all, K when all serve alike."""
    perplexities = {}
    for layer, used in enumerate(ids.unbind(1)):
        share = used.bincount().double() / len(used)
        entropy = -torch.special.xlogy(share, share).sum()
        perplexities[f"perplexity_{layer}"] = entropy.exp().item()
    return perplexities


def _build(config: RvqVaeConfig, inputs: StageInputs) -> Recipe:
    options: RvqOptions = inputs.options
    normalizer = fit_normalizer(inputs, root_contact_bias=options.root_contact_bias)
    config = config.for_features(normalizer.skeleton.feature_dim)
    return RvqRecipe(config, normalizer, inputs.train_clips, inputs.val_clips, options=options)


STAGE = Stage(
    "rvq",
    _build,
    by_size(RvqVaeConfig),
    SETTINGS,
    network="tokenizer",
    uses_text=False,
    options=RvqOptions(),
    starts_from_weights=False,
    samples=rebuilt_clips,
)
