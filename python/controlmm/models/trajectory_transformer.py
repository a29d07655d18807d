"""Masked trajectory transformer of TLControl: text and some joint trajectories -> codes of all body parts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from controlmm.models.masked_transformer import with_text_token
from controlmm.motion.body_parts import trajectory_joints
from controlmm.motion.skeleton import HUMANML3D, Skeleton
from controlmm.nn.checkpoint import PretrainedModel
from controlmm.nn.trunk import encoder_layers, initialize_weights, run_layers, sinusoidal_positions

# Of the six joints over all frames of HumanML3D, metres; published with the demo.
_PUBLISHED_MEAN, _PUBLISHED_STD = (0.00015, 0.7405, 0.3502), (0.5659, 0.5700, 0.9509)
_STEPS_A_SECOND = 20.0  # scales the difference of two frames of a walk to about 1


@dataclass(frozen=True)
class TrajectoryTransformerConfig:
    """Two transformer stages from bundles of frames to the codes of the body parts."""

    codebook_size: int = 128  # codes of each part
    width: int = 512
    heads: int = 4
    layers: int = 4
    feedforward: int = 2048
    head_width: int = 256  # of the second stage
    head_layers: int = 3
    head_feedforward: int = 1024
    dropout: float = 0.1
    text_dim: int = 512  # width of the text encoder's pooled vector
    text_scale: float = 1.0  # multiplies the text vector; unit-length vectors want about sqrt(text_dim)
    text_dropout: float = 0.0  # share of training samples that see no text
    downsample: int = 4  # frames in a bundle
    max_tokens: int = 49  # longest clip, in bundles
    joints: tuple[int, ...] = trajectory_joints(HUMANML3D)  # in the order of the body parts
    # "published": a token for every joint and bundle in both stages; a coordinate that is not given looks
    # like the mean position; tokens know only their place in the flat sequence; padding is attended.
    # "masked" also sees which coordinates are given and how they move, leaves padding out, has one token for
    # all joints of a bundle in the first stage (half the time), and an output layer for each part.
    form: Literal["masked", "published"] = "masked"

    def __post_init__(self) -> None:
        if self.width % self.heads or self.head_width % self.heads:
            raise ValueError(
                "`width` and `head_width` must be multiples of `heads`, "
                f"got {self.width}, {self.head_width} and {self.heads}."
            )
        if self.form not in ("masked", "published"):
            raise ValueError(f"`form` must be 'masked' or 'published', got {self.form!r}.")

    @classmethod
    def paper(cls) -> TrajectoryTransformerConfig:
        """The published network: 15.4 M parameters, CLIP text."""
        return cls(form="published")

    @classmethod
    def small(cls) -> TrajectoryTransformerConfig:
        """The size that ships: 3.1 M parameters, MiniLM text."""
        return cls(
            codebook_size=256,
            width=224,
            feedforward=768,
            head_width=128,
            head_layers=2,
            head_feedforward=512,
            dropout=0.0,
            text_dim=384,
            text_scale=20.0,
            text_dropout=0.1,
        )

    @classmethod
    def tiny(cls) -> TrajectoryTransformerConfig:
        """For tests."""
        return cls(
            codebook_size=16,
            width=16,
            heads=2,
            layers=1,
            feedforward=32,
            head_width=8,
            head_layers=1,
            head_feedforward=16,
            dropout=0.0,
            text_dim=64,
        )

    def for_text(self, text_dim: int) -> TrajectoryTransformerConfig:
        """The same sizes for another text encoder."""
        return replace(self, text_dim=text_dim)

    def for_skeleton(self, skeleton: Skeleton) -> TrajectoryTransformerConfig:
        """The same sizes for another skeleton."""
        return replace(self, joints=trajectory_joints(skeleton))

    @property
    def num_parts(self) -> int:
        """Trajectories, and codes of one time step."""
        return len(self.joints)

    @property
    def coordinates(self) -> int:
        """Numbers in one bundle of one joint."""
        return 3 * self.downsample


class TrajectoryTransformer(PretrainedModel):
    """Predicts the codes of all parts at once, without iterations."""

    config_class: ClassVar[type] = TrajectoryTransformerConfig
    training_state: ClassVar[tuple[str, ...]] = ("batches_seen",)
    config: TrajectoryTransformerConfig
    batches_seen: Tensor  # in training; a curriculum goes by it, also after a kill
    positions: Tensor
    trajectory_mean: Tensor
    trajectory_std: Tensor

    def __init__(self, config: TrajectoryTransformerConfig) -> None:
        super().__init__(config)
        is_published = config.form == "published"
        layers = partial(
            encoder_layers,
            heads=config.heads,
            dropout=config.dropout,
            activation="relu" if is_published else "gelu",
        )
        self.text_proj = nn.Linear(config.text_dim, config.width)
        parts, inputs = config.num_parts, config.coordinates
        self.bundle_proj = nn.Linear(inputs if is_published else 3 * parts * inputs, config.width)
        self.dropout = nn.Dropout(config.dropout)
        self.layers = layers(config.layers, width=config.width, feedforward=config.feedforward)
        self.to_head = nn.Linear(config.width, config.head_width * (1 if is_published else parts))
        self.head_layers = layers(
            config.head_layers, width=config.head_width, feedforward=config.head_feedforward
        )
        self.to_codes = nn.ModuleList(
            nn.Linear(config.head_width, config.codebook_size) for _ in range(1 if is_published else parts)
        )
        longest = 1 + config.max_tokens * parts if is_published else config.max_tokens
        self.register_buffer("positions", sinusoidal_positions(longest, config.width), persistent=False)
        self.part_embedding = None if is_published else nn.Embedding(parts, config.head_width)
        self.register_buffer("batches_seen", torch.tensor(0))
        self.register_buffer("trajectory_mean", torch.tensor(_PUBLISHED_MEAN))
        self.register_buffer("trajectory_std", torch.tensor(_PUBLISHED_STD))
        self.apply(initialize_weights)

    def trajectories(
        self, targets: Float[Tensor, "B T J 3"], mask: Bool[Tensor, "B T J 3"]
    ) -> tuple[Float[Tensor, "B T P 3"], Bool[Tensor, "B T P 3"]]:
        """The six joints' normalised trajectories, zero where not given, and which coordinates are given.

        Args:
            targets: Global positions in metres (of the skeleton's unit), canonical frame.
            mask: True where a coordinate is given; must be false behind the end of a clip.
        """
        joints = list(self.config.joints)
        given = mask[:, :, joints]
        normalized = (targets[:, :, joints] - self.trajectory_mean) / self.trajectory_std
        return normalized.where(given, 0.0), given

    def forward(
        self,
        trajectories: Float[Tensor, "B T P 3"],
        given: Bool[Tensor, "B T P 3"],
        text: Float[Tensor, "B E"],
        valid: Bool[Tensor, "B L"],
    ) -> Float[Tensor, "B L P K"]:
        """Logits of the codes of every part; see :meth:`trajectories` for the first two arguments.

        Raises:
            ValueError: If there are more tokens than ``max_tokens``.
        """
        if valid.shape[1] > self.config.max_tokens:
            raise ValueError(f"At most {self.config.max_tokens} tokens are possible, got {valid.shape[1]}.")
        text_token = self.text_proj(text * self.config.text_scale)[:, None]
        bundles = self._bundles(trajectories, given)
        if self.part_embedding is None:
            hidden = self._published(text_token, bundles)
            return torch.stack([self.to_codes[0](part) for part in hidden.unbind(2)], dim=2)
        hidden = self._masked(text_token, bundles, valid, self.part_embedding.weight)
        by_part = zip(self.to_codes, hidden.unbind(2), strict=True)
        return torch.stack([out(part) for out, part in by_part], dim=2)

    def _published(
        self, text_token: Float[Tensor, "B 1 W"], bundles: Float[Tensor, "B L P I"]
    ) -> Float[Tensor, "B L P H"]:
        """The sequence is the text token, then time-major every joint's bundle."""
        tokens = self.bundle_proj(bundles).flatten(1, 2)
        sequence = torch.cat([text_token, tokens], dim=1)
        sequence = self.dropout(sequence + self.positions[: sequence.shape[1]])
        everything = sequence.new_ones(sequence.shape[:2], dtype=torch.bool)
        hidden = run_layers(self.layers, sequence, everything)
        hidden = run_layers(self.head_layers, self.to_head(hidden), everything)
        by_part: Tensor = hidden[:, 1:].unflatten(1, bundles.shape[1:3])
        return by_part

    def _masked(
        self,
        text_token: Float[Tensor, "B 1 W"],
        bundles: Float[Tensor, "B L P I"],
        valid: Bool[Tensor, "B L"],
        part_embedding: Float[Tensor, "P H"],
    ) -> Float[Tensor, "B L P H"]:
        """First the text token and a token for each bundle of all joints, then a token for each part."""
        tokens = self.bundle_proj(bundles.flatten(2)) + self.positions[: bundles.shape[1]]
        sequence = self.dropout(torch.cat([text_token, tokens], dim=1))
        hidden = run_layers(self.layers, sequence, with_text_token(valid))[:, 1:]
        parts = self.to_head(hidden).unflatten(2, part_embedding.shape) + part_embedding
        of_part = valid.repeat_interleave(len(part_embedding), dim=1)
        hidden = run_layers(self.head_layers, parts.flatten(1, 2), of_part)
        by_part: Tensor = hidden.unflatten(1, bundles.shape[1:3])
        return by_part

    def _bundles(
        self, trajectories: Float[Tensor, "B T P 3"], given: Bool[Tensor, "B T P 3"]
    ) -> Float[Tensor, "B L P I"]:
        """Inputs of every token, frame-major inside a bundle."""
        channels = [trajectories]
        if self.config.form == "masked":
            # Differences say to the centimetre what positions of metres say only roughly.
            steps = nn.functional.pad(trajectories.diff(dim=1), (0, 0, 0, 0, 1, 0)) * _STEPS_A_SECOND
            both = given & nn.functional.pad(given[:, :-1], (0, 0, 0, 0, 1, 0))
            channels += [steps * both, given.to(trajectories.dtype)]
        size = self.config.downsample
        bundles = [
            x.unflatten(1, (-1, size)).transpose(2, 3).flatten(3) for x in channels
        ]  # (B, L, P, 3 size)
        return torch.cat(bundles, dim=-1)
