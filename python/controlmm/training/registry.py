"""The stages that can be trained, by name. A new stage is a module with a ``STAGE`` and a line here.

Nothing is imported before it is needed, so that the command can list the names without waiting for torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from controlmm.training.stage import Stage

_PACKAGE = "controlmm.training"

# name: module of controlmm.training; in the order in which a model is trained
MODULES = {
    "rvq": "rvq",
    "rvq-decoder": "rvq_decoder",
    "masked": "masked",
    "residual": "residual",
    "control": "control",
    "residual-control": "residual_control",
    "length": "length",
    "evaluator": "evaluator",
    "tl-vq": "tl_vq",
    "tl-decoder": "tl_decoder",
    "tl-mtt": "tl_mtt",
    "tl-unsplit": "tl_unsplit",
}


def load_stage(name: str) -> Stage:
    """The stage ``name``.

    Raises:
        ValueError: If there is no such stage.
    """
    if name not in MODULES:
        raise ValueError(f"Unknown stage {name!r}. Stages: {', '.join(MODULES)}.")
    stage: Stage = import_module(f"{_PACKAGE}.{MODULES[name]}").STAGE
    return stage
