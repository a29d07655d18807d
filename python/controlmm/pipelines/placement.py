"""Where the canonical motion stands in the user's world.

Networks work in a frame in which the pelvis starts at x = z = 0. A control that wants the pelvis elsewhere at
frame 0 therefore moves the whole scene there and back.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.controls import DenseControls


def start_position(controls: DenseControls) -> Float[Tensor, "3"]:
    """Where the controls want the root at frame 0, on the ground; the origin where they leave it free."""
    wanted = controls.targets[0, 0] * controls.mask[0, 0]
    return wanted * wanted.new_tensor([1, 0, 1])


def moved(controls: DenseControls, offset: Float[Tensor, "3"]) -> DenseControls:
    """The controls with all controlled coordinates moved by ``offset``."""
    return DenseControls(torch.where(controls.mask, controls.targets + offset, 0.0), controls.mask)
