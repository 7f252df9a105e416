"""The uVGS-2 solver: Levenberg-Marquardt on SE(3) with the analytic Jacobian through the exact distorted lens."""

from __future__ import annotations

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.pose_kernels import normal_equations, solve_damped, turn_and_shift
from uvgs_bench.sensor.solution import refining

# What is left to the minimum may be this at most: turn (rad) plus shift relative to the range.
_REMAINDER = 1e-11
# Rounding moves the cost by less than this, relative and absolute.
_ROUNDING = 1e-12
_ROUNDING_CHI2 = 1e-18


@compiled
def refine_pose(
    model_id: int,
    lens: FloatArray,
    points: FloatArray,
    px: FloatArray,
    sigma: FloatArray,
    R: FloatArray,
    t: FloatArray,
    max_iterations: int,
    give_up_chi2: float,
) -> tuple[float, int, bool]:
    """Minimise the whitened reprojection error from a start, in place.

    Args:
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        points: Beacon points, shape (n, 3), m.
        px: Observed centroids, shape (n, 2), raw px.
        sigma: Their deviations, shape (n,), px.
        R: Start and result, rotation camera_from_beacon, shape (3, 3).
        t: Start and result, translation, shape (3,), m.
        max_iterations: Most steps tried.
        give_up_chi2: Stop early when the third step still costs more than this; inf to never.

    Returns:
        Chi-square, steps tried, whether it converged.

    Source: (J^T J + mu I) xi = -J^T e, section 2.5 of the uVGS-2 paper, with mu scaled by the diagonal.
    """
    H = np.empty((6, 6))
    g = np.empty(6)
    H_new = np.empty((6, 6))
    g_new = np.empty(6)
    L = np.empty((6, 6))
    step = np.empty(6)
    residual = np.empty((points.shape[0], 2))
    R_new = np.empty((3, 3))
    t_new = np.empty(3)
    cost = normal_equations(model_id, lens, points, px, sigma, R, t, t, H, g, residual)
    if cost == np.inf:
        return np.inf, 0, False
    damping = 1e-6
    last = np.inf
    for iteration in range(max_iterations):
        if not solve_damped(H, g, damping, step, L):
            damping = max(10.0 * damping, 1e-6)
            if damping > 1e10:
                return cost, iteration + 1, False
            continue
        size = abs(step[0]) + abs(step[1]) + abs(step[2])
        size += (abs(step[3]) + abs(step[4]) + abs(step[5])) / (abs(t[0]) + abs(t[1]) + abs(t[2]))
        turn_and_shift(R, t, step, R_new, t_new)
        new_cost = normal_equations(model_id, lens, points, px, sigma, R_new, t_new, t_new, H_new, g_new, residual)
        if new_cost <= cost + _ROUNDING * cost + _ROUNDING_CHI2:
            for i in range(3):
                t[i] = t_new[i]
                for j in range(3):
                    R[i, j] = R_new[i, j]
            H, H_new = H_new, H
            g, g_new = g_new, g
            cost = new_cost
            damping = max(damping * 0.1, 1e-12)
            # Near the minimum steps shrink by a steady ratio, so the rest is a geometric series.
            if size < _REMAINDER or (size < 1e-6 and last < 1.0 and size * size < _REMAINDER * (last - size)):
                return cost, iteration + 1, True
            last = size
            if iteration >= 2 and cost > give_up_chi2:
                return cost, iteration + 1, False
        else:
            if size < 1e-9:
                return cost, iteration + 1, True
            damping = max(damping * 10.0, 1e-4)
            last = np.inf
            if damping > 1e10:
                return cost, iteration + 1, False
    return cost, max_iterations, False


solve = refining(refine_pose, np.inf)
