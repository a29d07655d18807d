"""Operators on motion tensors: C++ kernels with plain-torch twins. Tensors in, tensors out; no networks."""

from controlmm.ops.backend import (
    Backend,
    BuildInfo,
    active_isa,
    available_isas,
    build_info,
    use_backend,
    use_isa,
)
from controlmm.ops.consistency import masked_consistency_loss
from controlmm.ops.kinematics import recover_joints

__all__ = [
    "Backend",
    "BuildInfo",
    "active_isa",
    "available_isas",
    "build_info",
    "masked_consistency_loss",
    "recover_joints",
    "use_backend",
    "use_isa",
]
