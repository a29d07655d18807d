"""What the training loop asks of a network's recipe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from jaxtyping import Float
from torch import Tensor

from controlmm.nn.checkpoint import PretrainedModel


class Recipe(Protocol):
    """What is particular to one network."""

    @property
    def model(self) -> PretrainedModel:
        """The network in training."""

    def loss(self, batch_size: int) -> dict[str, Tensor]:
        """Losses of one fresh random batch; the entry ``loss`` is minimised, the others are logged."""

    def validate(self) -> dict[str, float]:
        """Metrics on the validation split; ``score`` decides which weights are kept (lower is better)."""

    def describe(self) -> dict[str, Any]:
        """What identifies the run: data list, hashes, options."""


@dataclass(frozen=True)
class Sample:
    """A recorded clip and what the network makes of it: joints (T, J, 3) in the skeleton's unit, Y up."""

    title: str
    recorded: Float[Tensor, "T J 3"]
    made: Float[Tensor, "T J 3"]
