"""Residual control: lets the residual layers make up for what the base layer still misses of the targets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from controlmm.models.missing_path import missing_in_heading
from controlmm.models.residual_transformer import ResidualTransformerConfig
from controlmm.motion.skeleton import Skeleton
from controlmm.nn.checkpoint import PretrainedModel
from controlmm.nn.conv import ConvEncoder
from controlmm.nn.trunk import zero_linear


@dataclass(frozen=True)
class ResidualControlConfig:
    """Control of a residual transformer of the same width and depth."""

    width: int = 384
    layers: int = 8
    num_quantizers: int = 6
    joints: tuple[int, ...] = (0, 10, 11, 15, 20, 21)  # that the control signal can name
    encoder_width: int = 256
    encoder_depth: int = 3
    dropout: float = 0.1
    downsample: int = 4
    signal_scale: float = 1.0  # metres for each unit of the skeleton: 0.001 for KIT-ML
    fps: float = 20.0

    def __post_init__(self) -> None:
        if not self.joints:
            raise ValueError("`joints` must name at least one joint.")

    @classmethod
    def paper(cls) -> ResidualControlConfig:
        """Beside the published residual transformer."""
        return cls()

    @classmethod
    def small(cls) -> ResidualControlConfig:
        """The size that ships, 0.3 M parameters: any of the 22 joints."""
        return cls(width=256, layers=4, joints=tuple(range(22)), encoder_width=64)

    @classmethod
    def tiny(cls) -> ResidualControlConfig:
        """For tests."""
        return cls(
            width=16, layers=2, num_quantizers=3, joints=tuple(range(22)), encoder_width=8, encoder_depth=1,
            dropout=0.0,
        )  # fmt: skip

    def for_skeleton(self, skeleton: Skeleton) -> ResidualControlConfig:
        """The same sizes for another skeleton: all of its joints, or its six control joints."""
        names_all = len(self.joints) > len(skeleton.control_joints)
        joints = tuple(range(skeleton.num_joints)) if names_all else skeleton.control_joints
        return replace(self, joints=joints, signal_scale=skeleton.metres, fps=skeleton.fps)

    def check_base(self, base: ResidualTransformerConfig) -> None:
        """Raise ``ValueError`` unless it fits the residual transformer."""
        mine = (self.width, self.layers, self.num_quantizers)
        theirs = (base.width, base.layers, base.num_quantizers)
        if mine != theirs:
            raise ValueError(
                f"The residual control has (width, layers, num_quantizers) = {mine}, but the residual "
                f"transformer has {theirs}; they must be equal."
            )


class ResidualControl(PretrainedModel):
    """Turns what is still missing into hints for every layer of a frozen residual transformer.

    ControlMM's residual layers do not see the targets, and undo a part of what the controlled base layer has
    reached. Here a small encoder reads where the motion of the layers so far misses, and zero linears
    (ControlNet style) add it to the hidden states, one factor for each channel and residual layer.
    """

    config_class: ClassVar[type] = ResidualControlConfig
    config: ResidualControlConfig

    def __init__(self, config: ResidualControlConfig) -> None:
        super().__init__(config)
        self.encoder = ConvEncoder(
            9 * len(config.joints),
            config.encoder_width,
            width=config.encoder_width,
            depth=config.encoder_depth,
            downsample=config.downsample,
            dropout=config.dropout,
        )
        self.factors = nn.Parameter(torch.ones(config.num_quantizers - 1, config.encoder_width))
        self.zeros = nn.ModuleList(
            zero_linear(config.encoder_width, config.width) for _ in range(config.layers + 1)
        )

    def signal(
        self,
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        current: Float[Tensor, "B T J 3"],
        *,
        strength: float = 1.0,
    ) -> Float[Tensor, "B T S"]:
        """What is missing (metres), the speed that would bring it (m/s), and which coordinates have targets.

        The first two are in the heading of ``current``, where the codes' velocities are, too.

        Args:
            targets: Global positions to reach, in the skeleton's unit.
            mask: Which coordinates are controlled.
            current: Positions of the motion decoded from the layers so far.
            strength: Factor of the speed. A network that was trained with 1 answers a miss with a part of
                what it takes, as training pulls it to natural codes, too; told of more, it does more.
        """
        joints = list(self.config.joints)
        missing, speed = missing_in_heading(
            targets, mask, current, metres=self.config.signal_scale, fps=self.config.fps
        )
        parts = [missing, strength * speed, mask.to(current.dtype)]
        return torch.cat([part[:, :, joints].flatten(2) for part in parts], dim=-1)

    def forward(
        self,
        signal: Float[Tensor, "B T S"],
        layer: Int[Tensor, "B"],
        valid: Bool[Tensor, "B L"],
    ) -> list[Float[Tensor, "B L W"]]:
        """Hints for residual layer ``layer`` (1..Q-1): one for the input, one for each transformer layer."""
        frames = valid.repeat_interleave(self.config.downsample, dim=1)
        encoded = torch.relu(self.encoder(signal.transpose(1, 2), frames).transpose(1, 2))
        encoded = encoded * self.factors[layer - 1][:, None]
        return [linear(encoded) for linear in self.zeros]
