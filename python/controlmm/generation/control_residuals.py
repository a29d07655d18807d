"""The control loss as a sum of squares: what Gauss-Newton sees of it."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controlmm.generation.code_spread import CodeSpread
from controlmm.generation.coordinate_groups import Groups
from controlmm.generation.kinematic_rows import KinematicPattern, KinematicRows
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.generation.naturalness import Naturalness
from controlmm.generation.one_thread import one_thread
from controlmm.generation.partial_decoder import PartialDecoder, controlled_joints
from controlmm.ops import recover_joints


@dataclass(frozen=True, eq=False)
class Probe:
    """One clip at one point.

    Attributes:
        residual: (N,) controlled coordinates minus their targets, metres, float64.
        features: (T, D) de-normalised channels of all joints, on its own frames; the root's come first.
        joints: (T, J, 3) what they decode to, metres.
        view: What the metric looks at of them.
        metres: Length of one unit of the joints.
        strain: Terms of naturalness, see :class:`Naturalness`.
    """

    residual: Float[Tensor, "N"]
    features: Float[Tensor, "T D"]
    joints: Float[Tensor, "T J 3"]
    view: ClipView
    metres: float
    strain: float

    @cached_property
    @one_thread()
    def loss(self) -> float:
        """Mean squared error, as of :class:`ControlObjective`."""
        return self.residual.square().mean().item() if len(self.residual) else 0.0

    @property
    def rows(self) -> KinematicRows:
        """How the residual, or the groups' sums of its coordinates, answer to the view's channels, here."""
        view = self.view
        return view.pattern.rows(
            self.features.index_select(1, view.channels), self.joints.index_select(1, view.joints)
        )


class ControlResiduals:
    """Controlled coordinates of decoded latents minus their targets.

    Args:
        decoder: Latents to joints.
        targets: (B, T, J, 3) metres.
        mask: (B, T, J, 3), the controlled coordinates.
        frames: (B, T), the frames of each clip.
        prefix: Latents of motions whose first ``prefix_frames`` frames are kept whatever is tried: features
            there count as constant, although tokens behind them would change them a little.
        prefix_frames: See ``prefix``.
        naturalness: What is kept small beside the residual.
    """

    def __init__(
        self,
        decoder: MotionDecoder,
        targets: Float[Tensor, "B T J 3"],
        mask: Bool[Tensor, "B T J 3"],
        frames: Bool[Tensor, "B T"],
        *,
        prefix: Float[Tensor, "B L C"] | None = None,
        prefix_frames: int = 0,
        naturalness: Naturalness | None = None,
    ) -> None:
        self.decoder, self._targets, self.naturalness = decoder, targets, naturalness
        # The metric knows joints that some clip controls. All are decoded: sums over fewer joints add up in
        # another order, and clips would depend on their company.
        led = controlled_joints(mask)
        self.channels = tuple(_channels_of(led))
        self._average: dict[int, Tensor] = {}  # products of the decoder's rows, for so many tokens
        self.part = PartialDecoder(decoder, range(mask.shape[2]), frames)
        self._look_at(
            [
                ClipView.of(clip[:length], led, self.part.std)
                for clip, length in zip(mask, frames.sum(1).tolist(), strict=True)
            ]
        )
        self._held: Tensor | None = None
        if prefix is not None:
            self._held = self.part.decode(prefix).features[:, :prefix_frames]

    def select(self, clips: Int[Tensor, "S"]) -> ControlResiduals:
        """The same for some of the clips; what is known of them stays so."""
        some = copy(self)
        some._targets, some.part = self._targets[clips], self.part.select(clips)
        some._look_at([self._views[clip] for clip in clips.tolist()])
        some._held = None if self._held is None else self._held[clips]
        some.naturalness = None if self.naturalness is None else self.naturalness.select(clips)
        return some

    def _look_at(self, views: Sequence[ClipView]) -> None:
        """``views`` are those of all clips; ``_places`` says where their coordinates are in flat joints."""
        self._views, apart = views, self._targets[:1].numel()
        places = [view.coordinates + clip * apart for clip, view in enumerate(views)]
        self._places = torch.cat([torch.zeros(0, dtype=torch.int64), *places])

    @torch.enable_grad()
    def probe(self, latents: Float[Tensor, "B L C"]) -> list[Probe]:
        """Residuals of all clips; the pass is kept for :meth:`pull`."""
        part = self.part
        self._decoded = part.decode(latents.detach(), is_looked_at_again=True)
        self._features = self._decoded.features.requires_grad_()
        features = self._features
        if self._held is not None:
            features = torch.cat([self._held, features[:, self._held.shape[1] :]], dim=1)
        features = features * part.std + part.mean
        self._joints = recover_joints(features, joints=len(part.joints))
        self._strains: Tensor | None = None
        strains = [0.0] * len(latents)
        if self.naturalness is not None:
            self._strains = self.naturalness.values(features, self._joints)
            strains = self._strains.tolist()
        joints, features = self._joints.detach(), features.detach()
        residuals = (joints - self._targets).flatten()[self._places].double().split(self.coordinates)
        metres = self.decoder.normalizer.skeleton.metres
        return [
            Probe(
                residual,
                own_features[: len(view.mask)],
                own_joints[: len(view.mask)],
                view,
                metres,
                strain,
            )
            for residual, own_features, own_joints, view, strain in zip(
                residuals, features, joints, self._views, strains, strict=True
            )
        ]

    @property
    def coordinates(self) -> list[int]:
        """How many each clip controls."""
        return [len(view.coordinates) for view in self._views]

    @property
    def spread(self) -> CodeSpread:
        """The unit of the latents' steps."""
        return self.decoder.spread()

    def gram(self, probe: Probe) -> Float[Tensor, "M M"]:
        """Products of the Jacobian's rows for a clip's residual, or for the sums that its view asks for.

        The decoder's part is that of an average clip.
        """
        tokens = len(probe.features) // self.decoder.downsample
        if tokens not in self._average:
            self._average[tokens] = self.decoder.channel_gram(self.channels, tokens)
        return probe.rows.gram(self._average[tokens], probe.view.columns)

    def pull(
        self, weights: Sequence[Float[Tensor, "N"] | None], *, strained: Sequence[bool] = ()
    ) -> Float[Tensor, "B L C"]:
        """Gradients at the latest probe of ``weights . residual``, plus the strain of ``strained`` clips.

        Zero for clips without weights.
        """
        gradient = torch.zeros_like(self._joints)
        gradient.view(-1)[self._places] = torch.cat(
            [
                torch.zeros(count) if wanted is None else wanted.float()
                for wanted, count in zip(weights, self.coordinates, strict=True)
            ]
        )
        outputs, slopes = [self._joints], [gradient]
        if self._strains is not None and any(strained):
            outputs.append(self._strains)
            counts = [
                is_strained and wanted is not None
                for is_strained, wanted in zip(strained, weights, strict=True)
            ]
            slopes.append(torch.tensor(counts, dtype=torch.float32))
        (features,) = torch.autograd.grad(outputs, self._features, slopes, retain_graph=True)
        return self.part.pull(self._decoded, features)

    def jacobian(self, clip: int, probe: Probe) -> Float[Tensor, "N L C"]:
        """Gradients of each of a clip's residuals at the latest probe, of which ``probe`` is its part."""
        view = probe.view
        assert view.groups is None  # of so many coordinates nobody asks for single rows
        rows = probe.rows.dense(len(view.channels)).float()
        if self._held is not None:
            rows[:, : self._held.shape[1]] = 0
        return self.part.pull_rows(self._decoded, clip, rows, [self.channels[i] for i in view.columns])


@dataclass(frozen=True, eq=False)
class ClipView:
    """What the metric looks at of a clip: the joints that it controls.

    Attributes:
        coordinates: Where the controlled ones are in the clip's flattened joints.
        joints: Which joints; all are decoded.
        channels: Their channels.
        columns: Which they are of those that the residuals' metric knows.
        mask: (T, J, 3) the controlled coordinates of these joints.
        std: Of the channels.
    """

    coordinates: Int[Tensor, "N"]
    joints: Int[Tensor, "J"]
    channels: Int[Tensor, "D"]
    columns: Int[Tensor, "D"]
    mask: Bool[Tensor, "T J 3"]
    std: Float[Tensor, "D"]

    @classmethod
    def of(cls, mask: Bool[Tensor, "T J 3"], led: Sequence[int], std: Float[Tensor, "C"]) -> ClipView:
        """Of a clip's own frames; a metric knows joints that are ``led``, ``std`` is that of all channels."""
        own = controlled_joints(mask[None])
        channels = torch.tensor(_channels_of(own))
        return cls(
            mask.flatten().nonzero()[:, 0],
            torch.tensor(own),
            channels,
            torch.tensor(_channels_of([led.index(joint) for joint in own])),
            mask[:, list(own)],
            std[channels],
        )

    @cached_property
    def groups(self) -> Groups | None:
        """Sums of coordinates that the metric knows instead, where there are many."""
        return Groups.of_many(self.mask)

    @cached_property
    def pattern(self) -> KinematicPattern:
        """Of the Jacobian's rows."""
        return KinematicPattern(self.mask, self.std, self.groups)


def _channels_of(joints: Sequence[int]) -> list[int]:
    """The root's channels and those of the other joints' positions, for joints that begin with the pelvis."""
    return [0, 1, 2, 3, *(1 + 3 * joint + axis for joint in joints[1:] for axis in range(3))]
