"""Standing a motion on the floor."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from controlmm.motion.layout import feature_layout
from controlmm.motion.skeleton import skeleton_of_width


def grounded(features: Float[Tensor, "*B T D"]) -> Float[Tensor, "*B T D"]:
    """De-normalised features moved up or down so that the lowest joint of each clip touches y = 0.

    That is where HumanML3D puts every recorded clip; a generated one may float, since recordings from stairs
    and uneven ground do. Only heights change: the root's and the joints' (metres).
    """
    layout = feature_layout(skeleton_of_width(features.shape[-1]))
    root, joints = features[..., layout.root_height], features[..., layout.local_positions]
    heights = joints.unflatten(-1, (-1, 3))[..., 1]  # (..., T, J-1)
    lowest = heights.flatten(-2).amin(-1).minimum(root.flatten(-2).amin(-1))
    return lifted(features, -lowest)


def lifted(features: Float[Tensor, "*B T D"], rise: Float[Tensor, "*B"]) -> Float[Tensor, "*B T D"]:
    """De-normalised features moved up by ``rise``, in the skeleton's unit; only heights change."""
    layout = feature_layout(skeleton_of_width(features.shape[-1]))
    moved = features.clone()
    moved[..., layout.root_height] += rise[..., None, None]
    joints = moved[..., layout.local_positions].unflatten(-1, (-1, 3)).clone()
    joints[..., 1] += rise[..., None, None]
    moved[..., layout.local_positions] = joints.flatten(-2)
    return moved
