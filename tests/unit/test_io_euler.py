from __future__ import annotations

import numpy as np
import pytest

from controlmm.io.euler import continuous_euler, matrix_from_euler

ORDERS = ("XYZ", "YZX", "ZXY", "XZY", "YXZ", "ZYX")
ROUNDING = 1e-12


def test_order_zxy_means_rz_rx_ry():
    quarter = np.pi / 2
    # Y acts first: x -> -z; then X: -z -> y; then Z: y -> -x.
    turned = matrix_from_euler(np.array([quarter, quarter, quarter]), "ZXY") @ np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(turned, [-1.0, 0.0, 0.0], atol=ROUNDING)


@pytest.mark.parametrize("order", ORDERS)
def test_angles_give_back_the_matrices_also_at_the_lock(order):
    angles = np.random.default_rng(0).uniform(-4, 4, (40, 3, 3))
    angles[:3, :, 1], angles[3:6, :, 1] = np.pi / 2, -np.pi / 2
    matrices = matrix_from_euler(angles, order)
    np.testing.assert_allclose(
        matrix_from_euler(continuous_euler(matrices, order), order), matrices, atol=ROUNDING
    )


@pytest.mark.parametrize("order", ORDERS)
def test_smooth_rotation_gives_smooth_angles_over_whole_turns(order):
    angles = np.zeros((200, 1, 3))
    angles[:, 0, 0] = np.linspace(0, 15, 200)
    angles[:, 0, 1] = np.linspace(0, 2.5, 200)  # passes the lock at a quarter turn
    found = continuous_euler(matrix_from_euler(angles, order), order)
    assert np.abs(np.diff(found, axis=0)).max() < 0.1
