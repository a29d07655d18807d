"""Drop-in replacements for functions that public motion code calls by these names."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from controlmm.ops.kinematics import recover_joints


def recover_from_ric(data: Float[Tensor, "*B T D"], joints_num: int) -> Float[Tensor, "*B T J 3"]:
    """Global joint positions of de-normalised features, under the name and arguments used across MDM, MoMask,
    OmniControl and their relatives. Differentiable; tensors on other devices take the plain-torch path.

    Args:
        data: De-normalised HumanML3D or KIT features.
        joints_num: 22 or 21.

    Raises:
        TypeError: If ``data`` is not a floating-point tensor.
        ValueError: If its shape does not fit ``joints_num``.
    """
    return recover_joints(data, joints=joints_num)
