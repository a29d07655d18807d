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
from controlmm.ops.exact import frame_bones, project_change, smooth_bones
from controlmm.ops.guidance import frames_last, guidance_value_and_grad
from controlmm.ops.gumbel import gumbel_noise, gumbel_straight_through
from controlmm.ops.kinematics import recover_joints
from controlmm.ops.obstacle_loss import obstacle_loss
from controlmm.ops.obstacles import (
    Box,
    Capsule,
    HalfSpace,
    HeightField,
    Obstacle,
    PackedObstacles,
    Plane,
    Sphere,
    pack_obstacles,
)
from controlmm.ops.signed_distance import signed_distances
from controlmm.ops.swing import swing_rotations
from controlmm.ops.winograd import winograd_frames, winograd_parts, winograd_weights
from controlmm.ops.winograd_tiles import WinogradTiles

__all__ = [
    "Backend",
    "Box",
    "BuildInfo",
    "Capsule",
    "HalfSpace",
    "HeightField",
    "Obstacle",
    "PackedObstacles",
    "Plane",
    "Sphere",
    "WinogradTiles",
    "active_isa",
    "available_isas",
    "build_info",
    "frame_bones",
    "frames_last",
    "guidance_value_and_grad",
    "gumbel_noise",
    "gumbel_straight_through",
    "masked_consistency_loss",
    "obstacle_loss",
    "pack_obstacles",
    "project_change",
    "recover_joints",
    "signed_distances",
    "smooth_bones",
    "swing_rotations",
    "use_backend",
    "use_isa",
    "winograd_frames",
    "winograd_parts",
    "winograd_weights",
]
