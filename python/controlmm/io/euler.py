"""Euler angles of rotation matrices, continuous over time, for files that store angles by axis."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

_AXES = "XYZ"


def matrix_from_euler(angles: Float[ndarray, "*B 3"], order: str) -> Float[ndarray, "*B 3 3"]:
    """Matrices of angles in radians; ``order`` "ZXY" means ``Rz Rx Ry`` (Y acts on a column first)."""
    first, second, third = (_axis_rotation(angles[..., i], _AXES.index(axis)) for i, axis in enumerate(order))
    result: ndarray = first @ second @ third
    return result


def _axis_rotation(angle: Float[ndarray, "*B"], axis: int) -> Float[ndarray, "*B 3 3"]:
    u, v = (axis + 1) % 3, (axis + 2) % 3
    result = np.zeros((*angle.shape, 3, 3))
    result[..., axis, axis] = 1
    result[..., u, u] = result[..., v, v] = np.cos(angle)
    result[..., v, u] = np.sin(angle)
    result[..., u, v] = -result[..., v, u]
    return result


def continuous_euler(matrices: Float[ndarray, "T J 3 3"], order: str) -> Float[ndarray, "T J 3"]:
    """Angles in radians, as the axes in ``order``, that move as little as possible between frames.

    Every rotation has two sets of angles, each repeating by full turns. Taking the set nearest to the frame
    before keeps curves smooth, so that a program that interpolates angles shows no spins.
    """
    angles = _principal_euler(matrices, order)
    other = np.stack([angles[..., 0] + np.pi, np.pi - angles[..., 1], angles[..., 2] + np.pi], axis=-1)
    result = angles.copy()
    for t in range(1, len(angles)):
        near = _nearest_turn(angles[t], result[t - 1])
        far = _nearest_turn(other[t], result[t - 1])
        is_far = _distance(far, result[t - 1]) < _distance(near, result[t - 1])
        result[t] = np.where(is_far[..., None], far, near)
    return result


def _nearest_turn(angles: Float[ndarray, "J 3"], reference: Float[ndarray, "J 3"]) -> Float[ndarray, "J 3"]:
    turn = 2 * np.pi
    result: ndarray = angles - turn * np.round((angles - reference) / turn)
    return result


def _distance(angles: Float[ndarray, "J 3"], reference: Float[ndarray, "J 3"]) -> Float[ndarray, "J"]:
    result: ndarray = np.abs(angles - reference).sum(-1)
    return result


def _principal_euler(matrices: Float[ndarray, "*B 3 3"], order: str) -> Float[ndarray, "*B 3"]:
    """The set of angles whose middle one lies within a quarter turn."""
    i, j, k = (_AXES.index(axis) for axis in order)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    first = np.arctan2(-sign * matrices[..., j, k], matrices[..., k, k])
    third = np.arctan2(-sign * matrices[..., i, j], matrices[..., i, i])
    cosine = np.hypot(matrices[..., i, i], matrices[..., i, j])
    middle = np.arctan2(sign * matrices[..., i, k], cosine)
    # At a quarter turn only a sum of the outer angles is defined: give it to the third.
    locked = cosine < 1e-7
    third_locked = np.arctan2(sign * matrices[..., j, i], matrices[..., j, j])
    return np.stack([np.where(locked, 0.0, first), middle, np.where(locked, third_locked, third)], axis=-1)
