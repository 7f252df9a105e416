"""Kernels of the error-state filter: the state through time, and what a measurement makes of it.

A state is one array of 21 numbers: position and velocity of the body in world axes, the rotation world_from_body row
by row, and the biases of accelerometers and gyroscopes in body axes. Its error has 15 numbers in the order position,
velocity, rotation, accelerometer bias, gyroscope bias. The rotation error acts on the left, in world axes:
``R_true = exp(theta^) R``; all others are true minus estimate.

Source: J. Solà, Quaternion kinematics for the error-state Kalman filter, chapter 7 (global angular error).
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.geometry.se3 import hat, so3_exp, so3_left_jacobian, so3_log
from uvgs_bench.geometry.small_matrices import product, times

STATE_SIZE = 21
ERROR_SIZE = 15


@compiled
def transition(
    state: FloatArray, imu: FloatArray, dt_s: float, gravity_mps2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """One step of the state under a constant reading, and its derivative.

    Args:
        state: The state, shape (21,).
        imu: Mean specific force (m/s^2) and mean rate (rad/s) over the step, body axes, shape (6,).
        dt_s: Length of the step, s.
        gravity_mps2: Gravity in world axes, shape (3,), m/s^2.

    Returns:
        The state after the step, shape (21,), and the derivative of its error by the error before, shape (15, 15).
    """
    R = state[6:15].copy().reshape(3, 3)
    force = imu[:3] - state[15:18]
    rate = imu[3:] - state[18:21]
    half = 0.5 * dt_s
    R_mid = product(R, so3_exp(half * rate))
    a = times(R_mid, force)
    out = state.copy()
    for i in range(3):
        out[i] += dt_s * state[3 + i] + 0.5 * dt_s * dt_s * (a[i] + gravity_mps2[i])
        out[3 + i] += dt_s * (a[i] + gravity_mps2[i])
    R_new = product(R, so3_exp(dt_s * rate))
    # One step of Newton towards an orthonormal matrix: rounding does not gather.
    gram = product(R_new, R_new.T.copy())
    out[6:15] = product(1.5 * np.eye(3) - 0.5 * gram, R_new).reshape(9)

    A = hat(a)
    # How the middle attitude and the last one turn with the gyroscopes' bias.
    turn_mid = product(R, so3_left_jacobian(half * rate)) * half
    turn = product(R, so3_left_jacobian(dt_s * rate)) * dt_s
    by_bias = product(A, turn_mid)
    F = np.eye(ERROR_SIZE)
    for i in range(3):
        F[i, 3 + i] = dt_s
        for j in range(3):
            F[i, 6 + j] = -0.5 * dt_s * dt_s * A[i, j]
            F[i, 9 + j] = -0.5 * dt_s * dt_s * R_mid[i, j]
            F[i, 12 + j] = 0.5 * dt_s * dt_s * by_bias[i, j]
            F[3 + i, 6 + j] = -dt_s * A[i, j]
            F[3 + i, 9 + j] = -dt_s * R_mid[i, j]
            F[3 + i, 12 + j] = dt_s * by_bias[i, j]
            F[6 + i, 12 + j] = -turn[i, j]
    return out, F


@compiled
def _sparse_times(F: FloatArray, P: FloatArray) -> FloatArray:
    """``F @ P`` for a mostly empty F."""
    n = F.shape[0]
    out = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            f = F[i, k]
            if f != 0.0:
                for j in range(n):
                    out[i, j] += f * P[k, j]
    return out


@compiled
def propagate(
    state: FloatArray,
    P: FloatArray,
    Phi: FloatArray,
    imu: FloatArray,
    dt_s: float,
    noise: FloatArray,
    gravity_mps2: FloatArray,
    with_transition: bool,
) -> None:
    """Carry a state and its covariance one step on, in place.

    Args:
        state: The state, shape (21,).
        P: Its covariance, shape (15, 15).
        Phi: Product of the derivatives so far, shape (15, 15); untouched unless asked for.
        imu: Mean reading over the step, shape (6,).
        dt_s: Length of the step, s, >= 0.
        noise: Densities and walks in the order of ``ImuNoise``, shape (4,).
        gravity_mps2: Gravity in world axes, shape (3,), m/s^2.
        with_transition: Whether to carry ``Phi`` on.
    """
    new, F = transition(state, imu, dt_s, gravity_mps2)
    state[:] = new
    carried = _sparse_times(F, _sparse_times(F, P).T.copy())
    # White noise of the readings acts as a bias does that is drawn anew for each step.
    white_a = noise[0] * noise[0] / dt_s if dt_s > 0.0 else 0.0
    white_g = noise[1] * noise[1] / dt_s if dt_s > 0.0 else 0.0
    for i in range(9):
        for j in range(i + 1):
            q = 0.0
            for k in range(3):
                q += white_a * F[i, 9 + k] * F[j, 9 + k] + white_g * F[i, 12 + k] * F[j, 12 + k]
            carried[i, j] += q
            if i != j:
                carried[j, i] += q
    for i in range(3):
        carried[9 + i, 9 + i] += noise[2] * noise[2] * dt_s
        carried[12 + i, 12 + i] += noise[3] * noise[3] * dt_s
    for i in range(ERROR_SIZE):
        for j in range(ERROR_SIZE):
            P[i, j] = 0.5 * (carried[i, j] + carried[j, i])
    if with_transition:
        Phi[:, :] = _sparse_times(F, Phi)


@compiled
def propagate_steps(
    state: FloatArray,
    P: FloatArray,
    readings: FloatArray,
    dt_s: FloatArray,
    noise: FloatArray,
    gravity_mps2: FloatArray,
) -> None:
    """Carry a state and its covariance many steps on, in place.

    Args:
        state: The state, shape (21,).
        P: Its covariance, shape (15, 15).
        readings: Mean reading over each step, shape (n, 6).
        dt_s: Length of each step, shape (n,), s.
        noise: Densities and walks in the order of ``ImuNoise``, shape (4,).
        gravity_mps2: Gravity in world axes, shape (3,), m/s^2.
    """
    Phi = np.zeros((1, 1))
    for k in range(len(dt_s)):
        propagate(state, P, Phi, readings[k], dt_s[k], noise, gravity_mps2, False)


@compiled
def pose_residual(state: FloatArray, R: FloatArray, position_m: FloatArray) -> FloatArray:
    """How far a measured pose is from a state.

    Args:
        state: The state, shape (21,).
        R: Measured rotation world_from_body, shape (3, 3).
        position_m: Measured position of the body in world axes, shape (3,), m.

    Returns:
        Rotation on the left (rad), then position (m), shape (6,).
    """
    out = np.empty(6)
    out[:3] = so3_log(product(R, state[6:15].copy().reshape(3, 3).T.copy()))
    for i in range(3):
        out[3 + i] = position_m[i] - state[i]
    return out


@compiled
def innovation_covariance(
    P: FloatArray, noise: FloatArray, rows: NDArray[np.int64], residual: FloatArray
) -> tuple[FloatArray, float]:
    """What is expected of the residual of a measurement that sees some errors directly, and how far it is off.

    Args:
        P: Covariance of the state, shape (15, 15).
        noise: Covariance of the measurement, shape (m, m).
        rows: Which errors it sees, shape (m,).
        residual: Measured minus expected, shape (m,).

    Returns:
        Lower Cholesky factor of the expected covariance, shape (m, m), and the squared Mahalanobis distance.
    """
    m = len(rows)
    L = np.zeros((m, m))
    for i in range(m):
        for j in range(i + 1):
            value = P[rows[i], rows[j]] + noise[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = sqrt(value) if value > 0.0 else 1e-150
            else:
                L[i, j] = value / L[j, j]
    distance = 0.0
    y = np.empty(m)
    for i in range(m):
        value = residual[i]
        for k in range(i):
            value -= L[i, k] * y[k]
        y[i] = value / L[i, i]
        distance += y[i] * y[i]
    return L, distance


@compiled
def correct(
    state: FloatArray,
    P: FloatArray,
    L: FloatArray,
    noise: FloatArray,
    rows: NDArray[np.int64],
    residual: FloatArray,
) -> None:
    """Correct a state by a measurement that sees some errors directly, in place; Joseph's form.

    Args:
        state: The state, shape (21,).
        P: Its covariance, shape (15, 15).
        L: Cholesky factor of the expected covariance of the residual, shape (m, m).
        noise: Covariance of the measurement, shape (m, m).
        rows: Which errors it sees, shape (m,).
        residual: Measured minus expected, shape (m,).
    """
    n, m = ERROR_SIZE, len(rows)
    K = np.empty((n, m))
    for i in range(n):
        for j in range(m):
            value = P[i, rows[j]]
            for k in range(j):
                value -= L[j, k] * K[i, k]
            K[i, j] = value / L[j, j]
        for j in range(m - 1, -1, -1):
            value = K[i, j]
            for k in range(j + 1, m):
                value -= L[k, j] * K[i, k]
            K[i, j] = value / L[j, j]
    A = np.eye(n)
    for i in range(n):
        for j in range(m):
            A[i, rows[j]] -= K[i, j]
    joseph = _sparse_times(A, _sparse_times(A, P).T.copy())
    spread = np.zeros((n, m))
    for i in range(n):
        for a in range(m):
            for b in range(m):
                spread[i, b] += K[i, a] * noise[a, b]
    for i in range(n):
        for j in range(n):
            for b in range(m):
                joseph[i, j] += spread[i, b] * K[j, b]
    for i in range(n):
        for j in range(n):
            P[i, j] = 0.5 * (joseph[i, j] + joseph[j, i])
    step = np.zeros(n)
    for i in range(n):
        for j in range(m):
            step[i] += K[i, j] * residual[j]
    move(state, step)


@compiled
def move(state: FloatArray, step: FloatArray) -> None:
    """Move a state by an error, in place.

    Args:
        state: The state, shape (21,).
        step: Error in the order of the file's head, shape (15,).
    """
    for i in range(6):
        state[i] += step[i]
    state[6:15] = product(so3_exp(step[6:9]), state[6:15].copy().reshape(3, 3)).reshape(9)
    for i in range(6):
        state[15 + i] += step[9 + i]
