"""The tokenizer's decoder for editing: values, and products with its Jacobian from both sides.

It is piecewise linear, so that one pass that remembers which units were on gives both products without an
autograd graph. Only the channels that an objective looks at are computed.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast
from weakref import ref

import torch
from jaxtyping import Float
from torch import Tensor, nn

from controlmm.generation.clip_groups import Lengths
from controlmm.generation.convolution_taps import Taps
from controlmm.generation.frozen_layers import FrozenConv
from controlmm.generation.repeated_ends import RepeatedEnds, repeated_ends
from controlmm.nn.conv import ConvDecoder, ResidualConvBlock, ResidualStack


@dataclass(frozen=True, eq=False)
class Tape:
    """What a pass through the decoder leaves for its Jacobian: inputs of rectifiers, in their order."""

    channels: tuple[int, ...]
    lengths: Lengths
    entry: Float[Tensor, "B L C"]
    blocks: tuple[tuple[Float[Tensor, "B T C"], Float[Tensor, "B T C"]], ...]
    smooth: Float[Tensor, "B T C"]

    def select(self, clips: Tensor) -> Tape:
        """The tape of some of the clips, of a row each; a clip may be named many times."""
        blocks = tuple((inner[clips], hidden[clips]) for inner, hidden in self.blocks)
        return Tape(self.channels, (), self.entry[clips], blocks, self.smooth[clips])

    def of_clip(self, clip: int, *, channels: Sequence[int], rows: int) -> Tape:
        """The tape of one of the clips that lie end to end, seen by some channels, ``rows`` times over."""
        first, length = sum(self.lengths[:clip]), self.lengths[clip]

        def own(x: Tensor) -> Tensor:
            scale = x.shape[1] // self.entry.shape[1]
            return x[:, scale * first : scale * (first + length)].expand(rows, -1, -1)

        blocks = tuple((own(inner), own(hidden)) for inner, hidden in self.blocks)
        return Tape(tuple(channels), (), own(self.entry), blocks, own(self.smooth))


class _Block:
    def __init__(self, block: ResidualConvBlock, dtype: torch.dtype, *, is_long: bool) -> None:
        self.dilated = FrozenConv.of(block.dilated, dtype, is_long=is_long)
        self.pointwise = FrozenConv.of(block.pointwise, dtype)


class FrozenDecoder:
    """A frozen copy of a :class:`ConvDecoder`, for clips of one length or for clips that lie end to end.

    Args:
        decoder: Where the weights come from. Later changes of it are not seen.
        dtype: Of the arithmetic. bfloat16 is for processors with AMX and for steps that need no exact value.
    """

    def __init__(self, decoder: ConvDecoder, *, dtype: torch.dtype = torch.float32) -> None:
        self._dtype = dtype
        self._repeats_ends, self._step = decoder.ends == "repeat", decoder.downsample
        self._entry = FrozenConv.of(decoder.entry, dtype)
        self._stacks = [
            [
                _Block(cast(ResidualConvBlock, block), dtype, is_long=doublings > 0)
                for block in cast(ResidualStack, stack)
            ]
            for doublings, stack in enumerate(decoder.stacks)
        ]
        ups = [Taps.of(cast(nn.Conv1d, up)) for up in decoder.up]
        self._smooth: FrozenConv | None = None
        if self._repeats_ends:
            # Nothing is rectified between the last doubling and smoothing: both are one convolution but at a
            # clip's ends, and frames there are cut off.
            ups[-1] = ups[-1].then(Taps.of(decoder.smooth))
        else:
            self._smooth = FrozenConv.of(decoder.smooth, dtype, is_long=True)
        self._ups = [
            FrozenConv.of_taps(up.of_doubled_frames(), dtype, is_long=doublings > 0)
            for doublings, up in enumerate(ups)
        ]
        self._exit = decoder.exit
        self._exits: dict[tuple[int, ...], FrozenConv] = {}

    def forward(
        self,
        latents: Float[Tensor, "B L C"],
        channels: Sequence[int],
        lengths: Lengths = (),
        *,
        is_looked_at_again: bool = False,
    ) -> tuple[Float[Tensor, "B T D"], Tape]:
        """Normalised features, only ``channels`` of them, and what the Jacobian products need.

        Each row is a clip, or there is one row of clips of ``lengths`` tokens. Latents that are looked at
        again and again, such as a solver's start and end, take but the last layer if they were those of the
        thread's latest such pass.
        """
        tape = _LATEST.pass_of(self, latents, lengths) if is_looked_at_again else None
        if tape is None:
            tape = self._run(latents, lengths)
            if is_looked_at_again:
                _LATEST.remember(self, latents, lengths, tape)
        tape = replace(tape, channels=tuple(channels))
        features = self._exit_for(tape.channels).forward(tape.smooth, self._frame_lengths(tape))
        return self._own_frames(features, tape).to(latents.dtype), tape

    def _run(self, latents: Float[Tensor, "B L C"], lengths: Lengths) -> Tape:
        """All layers but the last."""
        seen, lengths = self._with_ends(latents.to(self._dtype), lengths)
        tape_lengths = lengths
        x = entry = self._entry.forward(seen, lengths, is_rectified=True)
        saved = []
        for stack, up in zip(self._stacks, self._ups, strict=True):
            for block in stack:
                hidden = block.dilated.forward(x.clamp_min(0), lengths, is_rectified=True)
                saved.append((x, hidden))
                x = x + block.pointwise.forward(hidden)
            is_smooth = up is self._ups[-1] and self._smooth is None
            x, lengths = _halves(up.forward(x, lengths, is_rectified=is_smooth)), _twice(lengths)
        if self._smooth is not None:
            x = self._smooth.forward(x, lengths, is_rectified=True)
        return Tape((), tape_lengths, entry, tuple(saved), x)

    def pull(self, tape: Tape, gradient: Float[Tensor, "B T D"]) -> Float[Tensor, "B L C"]:
        """Gradient in the latents, given that in the features: the transposed Jacobian times a vector."""
        dtype, scales = gradient.dtype, [tape.lengths]
        for _ in self._stacks:
            scales.append(_twice(scales[-1]))
        lengths = scales.pop()
        gradient = self._with_frames_beyond(gradient.to(self._dtype), tape)
        gradient = self._exit_for(tape.channels).backward(gradient, lengths)
        gradient = _switched(gradient, tape.smooth)
        if self._smooth is not None:
            gradient = self._smooth.backward(gradient, lengths)
        saved = list(tape.blocks)
        for stack, up in zip(reversed(self._stacks), reversed(self._ups), strict=True):
            lengths = scales.pop()
            gradient = up.backward(_pairs(gradient), lengths)
            for block in reversed(stack):
                x, hidden = saved.pop()
                inner = _switched(block.pointwise.backward(gradient), hidden)
                gradient = gradient + _switched(block.dilated.backward(inner, lengths), x)
        gradient = self._entry.backward(_switched(gradient, tape.entry), lengths).to(dtype)
        return self._ends(tape).pulled(gradient) if self._repeats_ends else gradient

    def push(self, tape: Tape, tangent: Float[Tensor, "B L C"]) -> Float[Tensor, "B T D"]:
        """Change of the features for a small change of the latents: the Jacobian times a vector."""
        lengths = tape.lengths
        seen = self._ends(tape).added(tangent) if self._repeats_ends else tangent
        x = _switched(self._entry.forward(seen.to(self._dtype), lengths, is_tangent=True), tape.entry)
        saved = iter(tape.blocks)
        for stack, up in zip(self._stacks, self._ups, strict=True):
            for block in stack:
                before, hidden = next(saved)
                inner = block.dilated.forward(_switched(x, before), lengths, is_tangent=True)
                x = x + block.pointwise.forward(_switched(inner, hidden), is_tangent=True)
            x, lengths = _halves(up.forward(x, lengths, is_tangent=True)), _twice(lengths)
        if self._smooth is not None:
            x = self._smooth.forward(x, lengths, is_tangent=True)
        x = _switched(x, tape.smooth)
        x = self._exit_for(tape.channels).forward(x, lengths, is_tangent=True)
        return self._own_frames(x, tape).to(tangent.dtype)

    def _frame_lengths(self, tape: Tape) -> Lengths:
        return tuple(self._step * length for length in tape.lengths)

    def _with_ends(self, latents: Tensor, lengths: Lengths) -> tuple[Tensor, Lengths]:
        """What the convolutions see."""
        if not self._repeats_ends:
            return latents, lengths
        longer = repeated_ends(lengths or (latents.shape[1],)).added(latents)
        return longer, tuple(length + 2 for length in lengths)

    def _ends(self, tape: Tape) -> RepeatedEnds:
        return repeated_ends(tuple(length - 2 for length in tape.lengths or (tape.entry.shape[1],)))

    def _own_frames(self, features: Tensor, tape: Tape) -> Tensor:
        return features[:, self._ends(tape).frames(self._step)] if self._repeats_ends else features

    def _with_frames_beyond(self, gradient: Tensor, tape: Tape) -> Tensor:
        """The transpose of :meth:`_own_frames`."""
        if not self._repeats_ends:
            return gradient
        frames = tape.entry.shape[1] * self._step
        longer = gradient.new_zeros(len(gradient), frames, gradient.shape[2])
        longer[:, self._ends(tape).frames(self._step)] = gradient
        return longer

    def _exit_for(self, channels: tuple[int, ...]) -> FrozenConv:
        if channels not in self._exits:  # shares of a batch may each make one; it is stored when it is whole
            wanted, bias = list(channels), self._exit.bias
            assert bias is not None
            self._exits[channels] = FrozenConv(self._exit.weight[wanted], bias[wanted], 1, self._dtype)
        return self._exits[channels]


def _halves(x: Float[Tensor, "B T 2C"]) -> Float[Tensor, "B 2T C"]:
    return x.reshape(len(x), 2 * x.shape[1], -1)


def _pairs(x: Float[Tensor, "B 2T C"]) -> Float[Tensor, "B T 2C"]:
    return x.reshape(len(x), x.shape[1] // 2, -1)


def _twice(lengths: Lengths) -> Lengths:
    return tuple(2 * length for length in lengths)


def _switched(gradient: Float[Tensor, "B T C"], x: Float[Tensor, "B T C"]) -> Float[Tensor, "B T C"]:
    """``gradient`` where the rectifier of ``x`` was on."""
    result: Tensor = torch.ops.aten.threshold_backward(gradient, x, 0)
    return result


class _LatestPass(threading.local):
    """A thread's latest pass through a decoder: whose it was, of what, and its tape."""

    def __init__(self) -> None:
        self._known: tuple[ref[FrozenDecoder], Tensor, Lengths, bool, Tape] | None = None

    def pass_of(self, decoder: FrozenDecoder, latents: Tensor, lengths: Lengths) -> Tape | None:
        """The tape if it was of these."""
        if self._known is None:
            return None
        whose, seen, of, is_inference, tape = self._known
        is_same = (
            whose() is decoder
            and of == lengths
            and is_inference == torch.is_inference_mode_enabled()
            and seen.dtype == latents.dtype
            and torch.equal(seen, latents)
        )
        return tape if is_same else None

    def remember(self, decoder: FrozenDecoder, latents: Tensor, lengths: Lengths, tape: Tape) -> None:
        """Instead of the pass before."""
        is_inference = torch.is_inference_mode_enabled()
        self._known = ref(decoder), latents.clone(), lengths, is_inference, tape


_LATEST = _LatestPass()
