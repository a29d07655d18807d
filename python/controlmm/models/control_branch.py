"""Motion control model: a trainable copy of the masked trunk with zero linears (ControlNet style)."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from controlmm.models.masked_transformer import MaskedTransformer, MaskedTransformerConfig, with_text_token
from controlmm.models.missing_path import missing_in_heading
from controlmm.motion.skeleton import Skeleton
from controlmm.nn.checkpoint import PretrainedModel
from controlmm.nn.conv import ConvEncoder
from controlmm.nn.trunk import encoder_layers, zero_linear

_EncoderKind = Literal["convolution", "projection"]


@dataclass(frozen=True)
class ControlBranchConfig:
    """Control branch beside a masked transformer of the same width and depth."""

    width: int = 384
    heads: int = 6
    layers: int = 8
    feedforward: int = 1024
    dropout: float = 0.2
    joints: tuple[int, ...] = (0, 10, 11, 15, 20, 21)  # that the control signal can name
    has_observation_mask: bool = True  # say which targets exist; published: no, a zero target reads as none
    # Say in the body's heading what is missing, and which speed would bring it: ours, not published.
    sees_missing_speed: bool = False
    encoder_width: int = 512  # of the convolutional control encoder
    encoder_depth: int = 3
    downsample: int = 4
    into_frozen_trunk: bool = True  # published code; the paper's figure feeds only the copy
    encoder: _EncoderKind = "convolution"  # published code; the paper's words
    signal_scale: float = 1.0  # metres for each unit of the skeleton: 0.001 for KIT-ML
    fps: float = 20.0

    def __post_init__(self) -> None:
        if self.width % self.heads:
            raise ValueError(f"`width` must be a multiple of `heads`, got {self.width} and {self.heads}.")
        if self.encoder not in get_args(_EncoderKind):
            raise ValueError(f"`encoder` must be one of {get_args(_EncoderKind)}, got {self.encoder!r}.")
        if not self.joints:
            raise ValueError("`joints` must name at least one joint.")

    @property
    def signal_dim(self) -> int:
        """Channels of the control signal."""
        return len(self.joints) * (6 + 3 * self.has_observation_mask + 6 * self.sees_missing_speed)

    @classmethod
    def paper(cls) -> ControlBranchConfig:
        """The published size, 21.4 M parameters, for six joints, with the whole signal."""
        return cls(sees_missing_speed=True)

    @classmethod
    def published(cls) -> ControlBranchConfig:
        """The layout of the published weights: their signal is differences and targets only."""
        return cls(has_observation_mask=False)

    @classmethod
    def small(cls) -> ControlBranchConfig:
        """The size that ships: any of the 22 joints."""
        return cls(
            width=256,
            heads=4,
            layers=6,
            feedforward=512,
            dropout=0.1,
            joints=tuple(range(22)),
            sees_missing_speed=True,
            encoder_width=128,
        )

    @classmethod
    def tiny(cls) -> ControlBranchConfig:
        """For tests."""
        return cls(
            width=16, heads=2, layers=2, feedforward=32, dropout=0.0, joints=tuple(range(22)),
            sees_missing_speed=True, encoder_width=8, encoder_depth=1,
        )  # fmt: skip

    def for_skeleton(self, skeleton: Skeleton) -> ControlBranchConfig:
        """The same sizes for another skeleton: all of its joints, or its six control joints."""
        names_all = len(self.joints) > len(skeleton.control_joints)
        joints = tuple(range(skeleton.num_joints)) if names_all else skeleton.control_joints
        return replace(self, joints=joints, signal_scale=skeleton.metres, fps=skeleton.fps)

    def check_base(self, base: MaskedTransformerConfig) -> None:
        """Raise ``ValueError`` unless the branch fits the masked transformer."""
        mine = (self.width, self.heads, self.layers, self.feedforward)
        theirs = (base.width, base.heads, base.layers, base.feedforward)
        if mine != theirs:
            raise ValueError(
                f"The control branch has (width, heads, layers, feedforward) = {mine}, but the masked "
                f"transformer has {theirs}; they must be equal."
            )


class ControlBranch(PretrainedModel):
    """Turns control signals into residuals for every layer of the frozen masked transformer."""

    config_class: ClassVar[type] = ControlBranchConfig
    config: ControlBranchConfig

    def __init__(self, config: ControlBranchConfig) -> None:
        super().__init__(config)
        self.encoder = _signal_encoder(config)
        self.first_zero = zero_linear(config.width, config.width)
        self.layers = encoder_layers(
            config.layers,
            width=config.width,
            heads=config.heads,
            feedforward=config.feedforward,
            dropout=config.dropout,
        )
        self.mid_zeros = nn.ModuleList(zero_linear(config.width, config.width) for _ in range(config.layers))

    @classmethod
    def beside(cls, base: MaskedTransformer, config: ControlBranchConfig) -> ControlBranch:
        """A fresh branch whose layers are copies of ``base``'s; it changes nothing until it is trained.

        Raises:
            ValueError: If the sizes differ.
        """
        config.check_base(base.config)
        branch = cls(config)
        branch.layers.load_state_dict(copy.deepcopy(base.layers.state_dict()))
        return branch

    def signal(
        self,
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        current: Float[Tensor, "B T J 3"],
    ) -> Float[Tensor, "B T S"]:
        """The control signal: masked (target - current), masked target, the mask, and what is missing.

        Joint-major, in metres and m/s; the last part is :func:`missing_in_heading`'s. How many of the parts
        there are is a matter of the configuration.

        Args:
            targets: Global positions to reach, in the skeleton's unit.
            mask: Which coordinates are controlled.
            current: Positions of the motion decoded from the present tokens.
        """
        joints = list(self.config.joints)
        observed = mask[:, :, joints].to(current.dtype)
        scale = self.config.signal_scale
        difference = torch.where(mask, targets - current, 0.0)[:, :, joints] * scale
        target = torch.where(mask, targets, 0.0)[:, :, joints] * scale
        parts = [difference, target, observed] if self.config.has_observation_mask else [difference, target]
        if self.config.sees_missing_speed:
            ways = missing_in_heading(targets, mask, current, metres=scale, fps=self.config.fps)
            parts += [way[:, :, joints] for way in ways]
        return torch.cat([part.flatten(2) for part in parts], dim=-1)

    def forward(
        self,
        base: MaskedTransformer,
        sequence: Float[Tensor, "B S W"],
        signal: Float[Tensor, "B T C"],
        valid: Bool[Tensor, "B L"],
    ) -> Float[Tensor, "B L K"]:
        """Logits of ``base`` under control; ``sequence`` is :meth:`MaskedTransformer.sequence`'s."""
        return self.hinted_logits(base, sequence, self.hint(signal, valid), valid)

    def hint(self, signal: Float[Tensor, "B T C"], valid: Bool[Tensor, "B L"]) -> Float[Tensor, "B S W"]:
        """What the signal adds to the sequence, whatever the text."""
        frames = valid.repeat_interleave(self.config.downsample, dim=1)
        encoded = self.encoder(signal.transpose(1, 2), frames).transpose(1, 2)  # (B, L, W)
        return torch.nn.functional.pad(self.first_zero(encoded), (0, 0, 1, 0))  # nothing for the text token

    def hinted_logits(
        self,
        base: MaskedTransformer,
        sequence: Float[Tensor, "B S W"],
        hint: Float[Tensor, "B S W"],
        valid: Bool[Tensor, "B L"],
    ) -> Float[Tensor, "B L K"]:
        """As :meth:`forward`, with the :meth:`hint` that predictions with and without text share."""
        hidden = sequence + hint
        padding = ~with_text_token(valid)
        residuals = []
        for layer, zero in zip(self.layers, self.mid_zeros, strict=True):
            hidden = layer(hidden, src_key_padding_mask=padding)
            residuals.append(zero(hidden))
        start = sequence + hint if self.config.into_frozen_trunk else sequence
        return base.logits(start, valid, residuals)


class SignalProjection(nn.Module):
    """One linear map from the frames of a token to the token: the paper's "projection layer"."""

    def __init__(self, in_dim: int, out_dim: int, *, downsample: int) -> None:
        super().__init__()
        self.linear = nn.Conv1d(in_dim, out_dim, downsample, stride=downsample)

    def forward(
        self, x: Float[Tensor, "B D T"], valid: Bool[Tensor, "B T"] | None = None
    ) -> Float[Tensor, "B C L"]:
        """As :meth:`ConvEncoder.forward`."""
        projected: Tensor = self.linear(x)
        return projected if valid is None else projected * valid[:, None, :: self.linear.stride[0]]


def _signal_encoder(config: ControlBranchConfig) -> nn.Module:
    if config.encoder == "projection":
        return SignalProjection(config.signal_dim, config.width, downsample=config.downsample)
    return ConvEncoder(
        config.signal_dim,
        config.width,
        width=config.encoder_width,
        depth=config.encoder_depth,
        downsample=config.downsample,
        dropout=config.dropout,
    )
