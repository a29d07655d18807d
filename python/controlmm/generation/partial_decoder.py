"""The decoder as an objective sees it: some joints of clips of any lengths, padding left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from controlmm.generation.clip_groups import clips_end_to_end
from controlmm.generation.frozen_decoder import FrozenDecoder, Tape
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.ops import recover_joints


def controlled_joints(mask: Bool[Tensor, "B T J 3"]) -> tuple[int, ...]:
    """The pelvis, which carries all others, and the joints that some clip controls."""
    used = mask.any(-1).flatten(0, 1).any(0).nonzero()[:, 0].tolist()
    return (0, *(joint for joint in used if joint != 0))


@dataclass(frozen=True, eq=False)
class Decoded:
    """One pass: features (B, T, D') of the wanted joints, normalised, zero in padding; and the way back."""

    features: Float[Tensor, "B T D"]
    tapes: tuple[Tape, ...]


class PartialDecoder:
    """Decodes the channels of some joints: 4 of the root and 3 for every other one.

    Every clip is decoded at its own length, without padding, so that its numbers do not depend on the clips
    beside it.

    Args:
        decoder: The whole decoder.
        joints: Which joints, the pelvis (0) first.
        frames: (B, T), the frames of each clip.
        dtype: Of the decoder's arithmetic.
    """

    def __init__(
        self,
        decoder: MotionDecoder,
        joints: Sequence[int],
        frames: Bool[Tensor, "B T"],
        *,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.decoder, self.joints, self.frames, self._dtype = decoder, tuple(joints), frames, dtype
        self.channels = (0, 1, 2, 3, *(1 + 3 * j + axis for j in self.joints[1:] for axis in range(3)))
        channels = list(self.channels)
        self.mean, self.std = decoder.normalizer.mean[channels], decoder.normalizer.std[channels]
        self._frozen: FrozenDecoder = decoder.frozen(dtype)
        step = decoder.downsample
        tokens = frames[:, ::step]
        self.groups = clips_end_to_end(tokens.sum(1).tolist(), padded=tokens.shape[1], step=step)

    def select(self, clips: Int[Tensor, "S"]) -> PartialDecoder:
        """The same for some of the clips."""
        return PartialDecoder(self.decoder, self.joints, self.frames[clips], dtype=self._dtype)

    def decode(self, latents: Float[Tensor, "B L C"], *, is_looked_at_again: bool = False) -> Decoded:
        """Features of the wanted joints; see :meth:`FrozenDecoder.forward`."""
        step = self.decoder.downsample
        features = latents.new_zeros(len(latents), latents.shape[1] * step, len(self.channels))
        tapes = []
        for group in self.groups:
            clips = latents.flatten(0, 1)[None, group.tokens]
            decoded, tape = self._frozen.forward(
                clips, self.channels, group.lengths, is_looked_at_again=is_looked_at_again
            )
            features.flatten(0, 1)[group.frames] = decoded[0]
            tapes.append(tape)
        return Decoded(features, tuple(tapes))

    def positions(self, latents: Float[Tensor, "B L C"]) -> Float[Tensor, "B T J 3"]:
        """Global positions of the wanted joints, zero for the others."""
        features = self.decode(latents).features * self.std + self.mean
        found = recover_joints(features, joints=len(self.joints))
        positions = found.new_zeros(*found.shape[:2], self.decoder.normalizer.skeleton.num_joints, 3)
        positions[:, :, list(self.joints)] = found
        return positions

    def pull(self, decoded: Decoded, gradient: Float[Tensor, "B T D"]) -> Float[Tensor, "B L C"]:
        """The gradient in the latents, given that in the features of :meth:`decode`."""
        pulled = [
            self._frozen.pull(tape, gradient.flatten(0, 1)[None, group.frames])
            for group, tape in zip(self.groups, decoded.tapes, strict=True)
        ]
        channels = pulled[0].shape[-1] if pulled else 0
        tokens = gradient.shape[1] // self.decoder.downsample
        latents = gradient.new_zeros(len(gradient), tokens, channels)
        for group, part in zip(self.groups, pulled, strict=True):
            latents.flatten(0, 1)[group.tokens] = part[0]
        return latents

    def pull_rows(
        self, decoded: Decoded, clip: int, rows: Float[Tensor, "N T D"], channels: Sequence[int]
    ) -> Float[Tensor, "N L C"]:
        """As :meth:`pull` for one clip: many gradients, of its own frames in some channels of the decoder."""
        for group, tape in zip(self.groups, decoded.tapes, strict=True):
            if clip in group.clips:
                own = tape.of_clip(group.clips.index(clip), channels=channels, rows=len(rows))
                pulled = self._frozen.pull(own, rows)
                missing = self.frames.shape[1] // self.decoder.downsample - pulled.shape[1]
                return pad(pulled, (0, 0, 0, missing))
        raise IndexError(f"there is no clip {clip}")
