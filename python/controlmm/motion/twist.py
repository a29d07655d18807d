"""Aims bones and settles the spin about their own axis, which joint positions leave open.

Swing is the shortest rotation of the rest bone onto its target. The twist about the bone follows the hinge
below it (an elbow or knee bends in one plane only) as far as that is bent, stays near zero otherwise, and may
not jump between frames; the three wishes are one tridiagonal least-squares problem over time.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from controlmm.motion.rotations import quat_between, quat_conjugate, quat_multiply, quat_rotate

_REST_WEIGHT = 0.1  # pull towards no twist; a hinge bent by 90 degrees pulls with 1
_SMOOTHNESS = 2.0  # penalty on spin between frames: a window of about 4 frames where nothing else speaks
_FLOOR = 1e-4  # keeps the system solvable where a bone points exactly backwards
_TINY = 1e-9


def unit_or(vector: Float[Tensor, "T 3"], fallback: Float[Tensor, "*T 3"]) -> Float[Tensor, "T 3"]:
    """``vector`` at unit length, or ``fallback`` in frames where its length is zero."""
    norm = vector.norm(dim=-1, keepdim=True)
    return torch.where(norm > _TINY, vector / norm.clamp_min(_TINY), fallback.expand_as(vector))


def shortest_rotation(source: Float[Tensor, "*T 3"], target: Float[Tensor, "T 3"]) -> Float[Tensor, "T 4"]:
    """Shortest rotation between unit vectors; where they are opposite a half turn about any axis across."""
    source, target = torch.broadcast_tensors(source, target)
    axis = torch.nn.functional.one_hot(source.abs().argmin(-1), 3).to(source)
    across = torch.linalg.cross(source, axis, dim=-1)
    half_turn = torch.nn.functional.pad(across / across.norm(dim=-1, keepdim=True), (1, 0))
    opposite = (source * target).sum(-1, keepdim=True) < -1 + 1e-12
    return torch.where(opposite, half_turn, quat_between(source, target))


def twist_about(axis: Float[Tensor, "3"], angle: Float[Tensor, "T"]) -> Float[Tensor, "T 4"]:
    """Rotation by ``angle`` radians about the unit vector ``axis``."""
    return torch.cat([(angle / 2).cos()[:, None], (angle / 2).sin()[:, None] * axis], dim=-1)


def aim(
    base: Float[Tensor, "T 4"],
    rest: Float[Tensor, "3"],
    target: Float[Tensor, "T 3"],
    *,
    front: Float[Tensor, "T 3"] | None = None,
) -> Float[Tensor, "T 4"]:
    """Global rotation that carries the bone ``rest`` of a joint onto the direction ``target``.

    Args:
        base: Global rotation that the joint would have if it did nothing, its parent's.
        rest: Unit direction of the bone in the rest pose.
        target: Global direction of the bone; a zero vector leaves the joint as ``base`` has it.
        front: Global vector to which the bone's twist should turn the front of the rest pose (+Z). Only its
            part across the bone counts and is its strength, so a straight limb is not twisted.
    """
    inverse = quat_conjugate(base)
    local = unit_or(quat_rotate(inverse, target), rest)
    swing = shortest_rotation(rest, local)
    wish = weight = torch.zeros(len(base), dtype=base.dtype)
    if front is not None:
        across = quat_rotate(quat_conjugate(swing), quat_rotate(inverse, front))
        ahead = rest.new_tensor([0.0, 0.0, 1.0])
        sine, cosine = across @ torch.linalg.cross(rest, ahead), across @ ahead
        wish = torch.atan2(sine, cosine)
        # A limb never twists by half a turn: such a wish is noise, and its sign would flip.
        weight = (sine.square() + cosine.square()) * (1 + wish.cos()) / 2
    angle = _smooth_twist(_spins(swing, rest, local), wish, weight, rest_pull=(1 + local @ rest) / 2)
    return quat_multiply(base, quat_multiply(swing, twist_about(rest, angle)))


def _spins(
    swing: Float[Tensor, "T 4"], rest: Float[Tensor, "3"], local: Float[Tensor, "T 3"]
) -> Float[Tensor, "T-1"]:
    """Spin about the bone, in radians, that the swings alone make from each frame to the next."""
    carried = quat_multiply(shortest_rotation(local[:-1], local[1:]), swing[:-1])
    extra = quat_multiply(quat_conjugate(carried), swing[1:])
    angle = 2 * torch.atan2(extra[:, 1:] @ rest, extra[:, 0])
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def _smooth_twist(
    spins: Float[Tensor, "T-1"],
    wish: Float[Tensor, "T"],
    weight: Float[Tensor, "T"],
    *,
    rest_pull: Float[Tensor, "T"],
) -> Float[Tensor, "T"]:
    """Twist ``x`` of least ``weight (x - wish)^2 + pull x^2 + smooth (x[t+1] - x[t] + spin[t])^2`` over t."""
    pull = _REST_WEIGHT * rest_pull.square() + _FLOOR
    linked = torch.full_like(spins, _SMOOTHNESS)
    diagonal = weight + pull
    diagonal[:-1] += linked
    diagonal[1:] += linked
    right = weight * wish
    right[:-1] += linked * spins
    right[1:] -= linked * spins
    return right.new_tensor(_solve_tridiagonal(diagonal.tolist(), -_SMOOTHNESS, right.tolist()))


def _solve_tridiagonal(diagonal: list[float], off: float, right: list[float]) -> list[float]:
    """Thomas's algorithm for a symmetric matrix with one value beside its diagonal."""
    ratios, values = [0.0], [0.0]
    for d, r in zip(diagonal, right, strict=True):
        pivot = d - off * ratios[-1]
        ratios.append(off / pivot)
        values.append((r - off * values[-1]) / pivot)
    solution = [0.0]
    for ratio, value in zip(reversed(ratios[1:]), reversed(values[1:]), strict=True):
        solution.append(value - ratio * solution[-1])
    return solution[:0:-1]
