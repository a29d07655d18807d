"""The C++ extension. Private: use ``controlmm.ops``, which checks arguments and knows autograd."""

from typing import Any

# Any object of the DLPack protocol in CPU memory; outputs are written in place.
_Array = Any

def version() -> str: ...
def compiler() -> str: ...
def bindings() -> str: ...
def available_isas() -> list[str]: ...
def active_isa() -> str: ...
def set_isa(name: str, /) -> None: ...
def recover_joints(features: _Array, joints: _Array, threads: int, /) -> None: ...
def recover_joints_backward(
    features: _Array, grad_joints: _Array, grad_features: _Array, threads: int, /
) -> None: ...
def masked_consistency_loss(
    joints: _Array, targets: _Array, mask: _Array, norm: int, loss: _Array, counts: _Array, threads: int, /
) -> None: ...
def masked_consistency_loss_backward(
    joints: _Array,
    targets: _Array,
    mask: _Array,
    norm: int,
    grad_loss: _Array,
    counts: _Array,
    grad_joints: _Array,
    threads: int,
    /,
) -> None: ...
def obstacle_loss(
    joints: _Array,
    kinds: _Array,
    parameters: _Array,
    heights: _Array,
    radii: _Array,
    is_active: _Array,
    lengths: _Array,
    margin: float,
    is_mean: bool,
    loss: _Array,
    threads: int,
    /,
) -> None: ...
def obstacle_loss_backward(
    joints: _Array,
    kinds: _Array,
    parameters: _Array,
    heights: _Array,
    radii: _Array,
    is_active: _Array,
    lengths: _Array,
    margin: float,
    is_mean: bool,
    grad_loss: _Array,
    grad_joints: _Array,
    threads: int,
    /,
) -> None: ...
def guidance_value_and_grad(
    decoded: _Array,
    mean: _Array,
    std: _Array,
    targets: _Array,
    mask: _Array,
    norm: int,
    kinds: _Array,
    parameters: _Array,
    heights: _Array,
    radii: _Array,
    is_active: _Array,
    lengths: _Array,
    margin: float,
    is_mean: bool,
    obstacle_weight: float,
    loss: _Array,
    gradient: _Array,
    threads: int,
    /,
) -> None: ...
def control_value_and_grad(
    decoded: _Array,
    mean: _Array,
    std: _Array,
    targets: _Array,
    mask: _Array,
    norm: int,
    loss: _Array,
    gradient: _Array,
    threads: int,
    /,
) -> None: ...
def gumbel_noise(seed: int, first_clip: int, noise: _Array, threads: int, /) -> None: ...
def gumbel_straight_through(
    logits: _Array,
    codebook: _Array,
    temperature: float,
    seed: int,
    first_clip: int,
    ids: _Array,
    embeddings: _Array,
    probabilities: _Array,
    threads: int,
    /,
) -> None: ...
def softmax_backward(
    probabilities: _Array, temperature: float, gradient: _Array, threads: int, /
) -> None: ...
def project_change(
    parents: _Array,
    held: _Array,
    planted: _Array,
    stiffness: float,
    smoothness: float,
    standing: float,
    change: _Array,
    /,
) -> None: ...
def smooth_bones(
    parents: _Array,
    start: _Array,
    lengths: _Array,
    held: _Array,
    planted: _Array,
    feet: _Array,
    toes: _Array,
    stiffness: float,
    foot_resistance: float,
    steadiness: float,
    standing: float,
    bone_weight: float,
    damping: float,
    later_damping: float,
    enough: float,
    steps: int,
    joints: _Array,
    /,
) -> None: ...
def frame_bones(
    parents: _Array,
    lengths: _Array,
    held: _Array,
    planted: _Array,
    feet: _Array,
    stiffness: float,
    foot_resistance: float,
    standing: float,
    slack: float,
    enough: float,
    longest: float,
    steps: int,
    joints: _Array,
    /,
) -> None: ...
def swing_rotations(
    parents: _Array,
    starts: _Array,
    before: _Array,
    after: _Array,
    heading: _Array,
    rotations: _Array,
    /,
) -> None: ...
def winograd_parts(x: _Array, rows: _Array, parts: _Array, /) -> None: ...
def winograd_frames(
    products: _Array, rows: _Array, bias: _Array, is_rectified: bool, y: _Array, /
) -> None: ...
