"""Recipe that refines a tokenizer's decoder alone: encoder and codes stay, so tokens keep their meaning.

Tokenizers are trained on windows of 64 frames. Whole clips are longer, where errors of the root add up, or
shorter, where the zeros around a clip are near everywhere. Here the decoder sees whole clips of every length.
Transformers that were trained on the tokens stay valid.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import smooth_l1_loss
from torch.nn.utils.rnn import pad_sequence

from controlmm.data.clip import FeatureClip
from controlmm.models.rvq_vae import frame_mask
from controlmm.models.tokenizer import MotionTokenizer
from controlmm.motion.layout import feature_layout
from controlmm.motion.normalizer import Normalizer
from controlmm.nn.conv import DecoderEnds, check_ends
from controlmm.ops import recover_joints
from controlmm.training.rvq import POSITION_WEIGHT, reconstruction_errors
from controlmm.training.settings import TINY, TrainingSettings
from controlmm.training.stage import StageInputs, best_weights, have_same_codes
from controlmm.training.tokens import near_lengths, tokenize
from controlmm.training.windows import source_weights

SETTINGS = {
    "paper": TrainingSettings(steps=20_000, batch_size=64, learning_rate=1e-4, warmup=200, bf16=False),
    "small": TrainingSettings(
        steps=2500,
        batch_size=32,
        learning_rate=8e-5,  # 3e-4 tears the trained decoder apart before it mends it
        warmup=50,
        average_decay=0.995,
        validate_every=250,
        checkpoint_every=125,
    ),
    "tiny": TINY,
}
_LONGEST = 49  # tokens


@dataclass(frozen=True)
class DecoderOptions:
    """Weights of what is measured on the recovered joints, beside the reconstruction; and other ends."""

    joint_weight: float = 1.0  # distance from the recorded joints, in metres
    # Distance of the velocities, in metres a second. Positions alone let a decoder jitter around the right
    # place: jerk of rebuilt clips was twice that of recordings.
    velocity_weight: float = 0.2
    bone_weight: float = 1.0  # difference of the bones' lengths, in metres; features do not keep them
    acceleration_weight: float = 0.0  # distance of the accelerations, in metres a second squared
    ends: DecoderEnds | None = None  # what the decoder sees beyond a clip; None: as it was trained

    def __post_init__(self) -> None:
        for name in ("joint_weight", "velocity_weight", "bone_weight", "acceleration_weight"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"`{name}` must not be negative, got {getattr(self, name)}.")
        if self.ends is not None:
            check_ends(self.ends)


class DecoderRecipe:
    """Smooth-L1 reconstruction of whole clips from their codes, and what :class:`DecoderOptions` weighs.

    As in a residual tokenizer's own training the share ``layer_dropout`` of the clips loses its upper layers
    of codes, so that the base codes alone, which control is trained on, keep their motions.
    """

    def __init__(
        self,
        model: MotionTokenizer,
        normalizer: Normalizer,
        train_clips: Sequence[FeatureClip],
        val_clips: Sequence[FeatureClip],
        *,
        stage: str,
        options: DecoderOptions = DecoderOptions(),
        layer_dropout: float = 0.0,
        progress: bool = True,
    ) -> None:
        self.model = model
        self.model.requires_grad_(False)
        self.model.decoder.requires_grad_(True)
        self.normalizer, self.options = normalizer, options
        self._stage, self._layer_dropout = stage, layer_dropout
        step = model.downsample
        clips = [clip for clip in train_clips if len(clip.features) >= 2 * step]
        self._val_clips = [clip for clip in val_clips if len(clip.features) >= step]
        if not clips or not self._val_clips:
            raise ValueError(f"Both splits need clips of at least {2 * step} frames.")
        self._features = [normalizer.normalize(clip.features) for clip in clips]
        self._ids = tokenize(self._features, model, progress=progress)
        self._lengths = torch.tensor([len(clip.features) for clip in clips])
        self._weights = source_weights([clip.source for clip in clips], self._lengths.tolist())
        self._positions = feature_layout(normalizer.skeleton).local_positions

    def loss(self, batch_size: int) -> dict[str, Tensor]:
        """Losses of a random batch of whole clips."""
        ids, target, frames = (tensor.to(self.model.device) for tensor in self._sample(batch_size))
        decoded = self.model.decode(self.model.quantizer.lookup(ids), frames).float()
        shown, wanted = decoded[frames], target[frames]
        reconstruction = smooth_l1_loss(shown, wanted)
        positions = smooth_l1_loss(shown[:, self._positions], wanted[:, self._positions])
        on_joints = self._joint_losses(self._joints(decoded), self._joints(target), frames)
        loss = reconstruction + POSITION_WEIGHT * positions
        loss = loss + sum(
            getattr(self.options, f"{name}_weight") * value for name, value in on_joints.items()
        )
        return {"loss": loss, "reconstruction": reconstruction, "positions": positions, **on_joints}

    def validate(self) -> dict[str, float]:
        """Joint errors over whole clips, see :func:`reconstruction_errors`."""
        return reconstruction_errors(self.model, self.normalizer, self._val_clips)

    def describe(self) -> dict[str, Any]:
        """Options of this recipe."""
        return {"stage": self._stage, "losses": dataclasses.asdict(self.options)}

    def _joint_losses(
        self, shown: Float[Tensor, "B T J 3"], wanted: Float[Tensor, "B T J 3"], frames: Bool[Tensor, "B T"]
    ) -> dict[str, Tensor]:
        """Mean distances of joints (m), velocities (m/s), bone lengths (m) and accelerations (m/s^2)."""
        skeleton = self.normalizer.skeleton
        steps = frames[:, 1:] & frames[:, :-1]
        parents = torch.tensor(skeleton.parents[1:], device=shown.device)
        bones = [(joints[..., 1:, :] - joints[..., parents, :]).norm(dim=-1) for joints in (shown, wanted)]
        off = (shown - wanted) * skeleton.metres
        velocity, acceleration = (off.diff(n=order, dim=1) * skeleton.fps**order for order in (1, 2))
        return {
            "joint": off.norm(dim=-1)[frames].mean(),
            "velocity": velocity.norm(dim=-1)[steps].mean(),
            "bone": (bones[0] - bones[1]).abs()[frames].mean() * skeleton.metres,
            "acceleration": acceleration.norm(dim=-1)[steps[:, 1:]].mean(),
        }

    def _sample(self, count: int) -> tuple[Int[Tensor, "B L Q"], Float[Tensor, "B T D"], Bool[Tensor, "B T"]]:
        """``count`` clips of about the same length, each from one of its first few frames on."""
        step = self.model.downsample
        ids, targets = [], []
        for clip in near_lengths(self._lengths, self._weights, count):
            offset = int(torch.randint(step, ()))
            tokens = self._ids[clip][offset]
            start = int(torch.randint(max(0, len(tokens) - _LONGEST) + 1, ()))
            chosen = tokens[start : start + _LONGEST].long()
            if torch.rand(()) < self._layer_dropout:
                chosen[:, int(torch.randint(chosen.shape[1], ())) + 1 :] = -1
            first = offset + step * start
            ids.append(chosen)
            targets.append(self._features[clip][first : first + step * len(chosen)])
        target = pad_sequence(targets, batch_first=True)
        frames = frame_mask(torch.tensor([len(x) for x in targets]), target.shape[1])
        return pad_sequence(ids, batch_first=True, padding_value=-1), target, frames

    def _joints(self, features: Float[Tensor, "B T D"]) -> Float[Tensor, "B T J 3"]:
        normalizer = self.normalizer.to(features.device)
        return recover_joints(normalizer.denormalize(features), joints=normalizer.skeleton.num_joints)


_Tokenizer = TypeVar("_Tokenizer", bound=MotionTokenizer)


def tokenizer_to_refine(network: type[_Tokenizer], stage: str, inputs: StageInputs) -> _Tokenizer:
    """The trained tokenizer of ``stage``, or the weights to start from if they have its codes.

    With the ends that the options name.

    Raises:
        FileNotFoundError: If the stage is not trained yet.
        ValueError: If the weights to start from have other codes.
    """
    model = network.from_pretrained(best_weights(inputs.root, stage))
    if inputs.start is not None:
        given = network.from_pretrained(inputs.start)
        if not have_same_codes(given, model):
            raise ValueError(
                f"{inputs.start} has other codes than {inputs.root / stage}; a decoder can only be refined "
                "for the codes that tokens are made with. Choose another --out."
            )
        model = given
    ends = inputs.options.ends
    return model if ends is None else _with_ends(model, ends)


def _with_ends(model: _Tokenizer, ends: DecoderEnds) -> _Tokenizer:
    changed = type(model)(dataclasses.replace(model.config, decoder_ends=ends))
    changed.load_state_dict(model.state_dict())
    return changed.eval()
