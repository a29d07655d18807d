"""Exponential moving average of the weights: calmer than the last step's, often a little better."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn

_YOUNG = 10  # updates; a young average follows faster, so that fresh weights do not weigh on it


class WeightAverage:
    """Running average of the trainable parameters of ``model``; with ``decay`` 0 there is none.

    After ``n`` updates the decay is ``min(decay, (1 + n) / (10 + n))``. Buffers (such as codebooks, which are
    averages already) are not averaged.
    """

    def __init__(self, model: nn.Module, decay: float) -> None:
        self.decay, self.updates = decay, 0
        self._parameters = {n: p for n, p in model.named_parameters() if p.requires_grad}
        self._average = {n: p.detach().clone() for n, p in self._parameters.items()} if decay else {}

    @torch.no_grad()
    def update(self) -> None:
        """Take in the present weights."""
        decay = min(self.decay, (1 + self.updates) / (_YOUNG + self.updates))
        for name, average in self._average.items():
            average.lerp_(self._parameters[name], 1 - decay)
        self.updates += 1

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Inside, the model has the averaged weights."""
        own = {name: self._parameters[name].data for name in self._average}
        try:
            for name, average in self._average.items():
                self._parameters[name].data = average
            yield
        finally:
            for name, values in own.items():
                self._parameters[name].data = values

    def state(self) -> dict[str, Tensor]:
        """The averages by parameter name; empty when averaging is off."""
        return dict(self._average)

    def load_state(self, state: Mapping[str, Tensor], *, updates: int) -> None:
        """Put back what :meth:`state` gave.

        Raises:
            KeyError: If a parameter's average is missing.
        """
        for name, average in self._average.items():
            average.copy_(state[name])
        self.updates = updates
