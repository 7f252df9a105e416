"""The left Jacobian of SE(3) against central differences."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.geometry.se3 import se3_exp, se3_left_jacobian, se3_log, so3_exp, so3_left_jacobian, so3_log

STEP = 1e-6  # rad and m: central differences are then good to about 1e-9


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 1e-5, 1e-3, 0.00999, 0.01001, 0.0999, 0.1001, 1.0, 2.0, 3.0, 3.1415])
def test_left_jacobian(angle_rad):
    rng = np.random.default_rng(int(angle_rad * 1e6) + 7)
    w = 0.7 * rng.normal(size=3)
    xi = np.concatenate([w * angle_rad / np.linalg.norm(w), rng.normal(size=3)])
    R, t = se3_exp(xi)
    numeric = np.empty((6, 6))
    for i in range(6):
        step = np.zeros(6)
        step[i] = STEP
        ends = []
        for sign in (1.0, -1.0):
            R2, t2 = se3_exp(xi + sign * step)
            ends.append(se3_log(np.ascontiguousarray(R2 @ R.T), t2 - R2 @ R.T @ t))
        numeric[:, i] = (ends[0] - ends[1]) / (2.0 * STEP)
    np.testing.assert_allclose(se3_left_jacobian(xi), numeric, atol=2e-9)
    np.testing.assert_allclose(se3_left_jacobian(xi)[:3, :3], so3_left_jacobian(xi[:3].copy()), atol=1e-15)


def test_left_update_moves_the_rotation_first():
    rng = np.random.default_rng(3)
    w = 0.7 * rng.normal(size=3)
    d = 1e-7 * rng.normal(size=3)
    np.testing.assert_allclose(
        so3_log(so3_exp(d) @ so3_exp(w)) - w, np.linalg.solve(so3_left_jacobian(w), d), atol=1e-13
    )
