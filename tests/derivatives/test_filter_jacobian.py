"""The derivatives the error-state filter works with, against central differences."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.geometry.se3 import so3_exp, so3_log
from uvgs_bench.navigation.filter_kernels import ERROR_SIZE, move, pose_residual, transition

STEP = 1e-6  # m, m/s, rad, m/s^2, rad/s: central differences are then good to about 1e-9


def random_state(rng):
    return np.concatenate(
        (
            rng.normal(size=6),
            so3_exp(rng.normal(size=3)).reshape(9),
            0.1 * rng.normal(size=3),
            0.01 * rng.normal(size=3),
        )
    )


def difference(a, b):
    turn = so3_log(np.ascontiguousarray(a[6:15].reshape(3, 3) @ b[6:15].reshape(3, 3).T))
    return np.concatenate((a[:6] - b[:6], turn, a[15:] - b[15:]))


def moved(state, k, size):
    out, step = state.copy(), np.zeros(ERROR_SIZE)
    step[k] = size
    move(out, step)
    return out


@pytest.mark.parametrize("dt_s", [0.0, 0.001, 0.008, 0.1])
@pytest.mark.parametrize("gravity", [0.0, -9.81])
def test_transition(dt_s, gravity):
    rng = np.random.default_rng(4)
    down = np.array([0.0, 0.0, gravity])
    for _ in range(5):
        state, imu = random_state(rng), np.concatenate((5.0 * rng.normal(size=3), rng.normal(size=3)))
        _, F = transition(state, imu, dt_s, down)
        numeric = np.empty((ERROR_SIZE, ERROR_SIZE))
        for k in range(ERROR_SIZE):
            ends = [transition(moved(state, k, sign * STEP), imu, dt_s, down)[0] for sign in (1.0, -1.0)]
            numeric[:, k] = difference(ends[0], ends[1]) / (2.0 * STEP)
        # Forces of some 10 m/s^2 over steps of 0.1 s: rounding of 1e-15 over a step of 1e-6.
        np.testing.assert_allclose(F, numeric, atol=5e-9)


def test_residual_of_a_pose_sees_rotation_and_position_directly():
    rng = np.random.default_rng(5)
    state = random_state(rng)
    R, place = state[6:15].reshape(3, 3).copy(), state[:3].copy()
    H = np.empty((6, ERROR_SIZE))
    for k in range(ERROR_SIZE):
        # Truth moves away from the estimate: the measured pose moves with it.
        ends = []
        for sign in (1.0, -1.0):
            true = moved(state, k, sign * STEP)
            ends.append(pose_residual(state, true[6:15].reshape(3, 3).copy(), true[:3].copy()))
        H[:, k] = (ends[0] - ends[1]) / (2.0 * STEP)
    wanted = np.zeros((6, ERROR_SIZE))
    wanted[range(6), [6, 7, 8, 0, 1, 2]] = 1.0
    np.testing.assert_allclose(H, wanted, atol=1e-9)
    np.testing.assert_allclose(pose_residual(state, R, place), np.zeros(6), atol=1e-15)


def test_step_follows_the_equations_of_motion():
    """Constant turn and force: many small steps and the exact solution agree."""
    state, down = random_state(np.random.default_rng(6)), np.array([0.0, 0.0, -9.81])
    state[15:] = 0.0
    imu = np.array([0.3, -0.2, 9.7, 0.2, -0.4, 0.3])
    coarse, fine = state, state
    for _ in range(50):
        coarse, _ = transition(coarse, imu, 0.01, down)
    for _ in range(5000):
        fine, _ = transition(fine, imu, 0.0001, down)
    # The turn within a step is taken at its middle: |rate| |force| dt^2 T / 12 of position, 2.2e-5 m here.
    np.testing.assert_allclose(coarse, fine, atol=2.5e-5)
    np.testing.assert_allclose(
        coarse[6:15].reshape(3, 3), state[6:15].reshape(3, 3) @ so3_exp(0.5 * imu[3:]), atol=1e-12
    )
