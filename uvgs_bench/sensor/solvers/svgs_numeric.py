"""The SVGS baseline: the same Levenberg-Marquardt, its Jacobian by finite differences, compiled like the other.

Differences are central: with one-sided ones the minimum itself would move by more than 1e-9.
"""

from __future__ import annotations

import numpy as np

from uvgs_bench.camera.lens_kernels import project_point
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.pose_kernels import solve_damped, turn_and_shift
from uvgs_bench.sensor.solution import refining

# Turn (rad), and shift relative to the range: truncation 1e-10 and rounding 1e-11 of the derivative meet here.
_DIFFERENCE = 1e-5
# What is left to the minimum may be this at most: turn (rad) plus shift relative to the range.
_REMAINDER = 1e-11
# Rounding moves the cost by less than this, relative and absolute.
_ROUNDING = 1e-12
_ROUNDING_CHI2 = 1e-18


@compiled
def _residuals(
    model_id: int, lens: FloatArray, points: FloatArray, px: FloatArray, sigma: FloatArray, R: FloatArray,
    t: FloatArray, out: FloatArray,
) -> float:  # fmt: skip
    """Whitened residuals, out shape (2n,). Returns their sum of squares, inf when a point cannot be projected."""
    total = 0.0
    for i in range(points.shape[0]):
        x = R[0, 0] * points[i, 0] + R[0, 1] * points[i, 1] + R[0, 2] * points[i, 2] + t[0]
        y = R[1, 0] * points[i, 0] + R[1, 1] * points[i, 1] + R[1, 2] * points[i, 2] + t[1]
        z = R[2, 0] * points[i, 0] + R[2, 1] * points[i, 1] + R[2, 2] * points[i, 2] + t[2]
        u, v, is_valid = project_point(model_id, lens, x, y, z)
        if not is_valid:
            return np.inf
        e = (px[i, 0] - u) / sigma[i]
        f = (px[i, 1] - v) / sigma[i]
        out[2 * i] = e
        out[2 * i + 1] = f
        total += e * e + f * f
    return total


@compiled
def numeric_jacobian(
    model_id: int, lens: FloatArray, points: FloatArray, px: FloatArray, sigma: FloatArray, R: FloatArray,
    t: FloatArray, J: FloatArray,
) -> bool:  # fmt: skip
    """Jacobian of the whitened residuals by a turn about the beacon and a shift, by central differences.

    Args:
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        points: Beacon points, shape (n, 3), m.
        px: Observed centroids, shape (n, 2), raw px.
        sigma: Their deviations, shape (n,), px.
        R: Rotation camera_from_beacon, shape (3, 3).
        t: Translation, shape (3,), m.
        J: Output, shape (2n, 6).

    Returns:
        False when a point cannot be projected.
    """
    scale = abs(t[0]) + abs(t[1]) + abs(t[2])
    step = np.zeros(6)
    R_moved = np.empty((3, 3))
    t_moved = np.empty(3)
    ahead = np.empty(J.shape[0])
    behind = np.empty(J.shape[0])
    for j in range(6):
        h = _DIFFERENCE if j < 3 else _DIFFERENCE * scale
        step[j] = h
        turn_and_shift(R, t, step, R_moved, t_moved)
        if _residuals(model_id, lens, points, px, sigma, R_moved, t_moved, ahead) == np.inf:
            return False
        step[j] = -h
        turn_and_shift(R, t, step, R_moved, t_moved)
        if _residuals(model_id, lens, points, px, sigma, R_moved, t_moved, behind) == np.inf:
            return False
        step[j] = 0.0
        for i in range(J.shape[0]):
            J[i, j] = (ahead[i] - behind[i]) / (2.0 * h)
    return True


@compiled
def refine_numerically(
    model_id: int, lens: FloatArray, points: FloatArray, px: FloatArray, sigma: FloatArray, R: FloatArray,
    t: FloatArray, max_iterations: int,
) -> tuple[float, int, bool]:  # fmt: skip
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

    Returns:
        Chi-square, steps tried, whether it converged.
    """
    rows = 2 * points.shape[0]
    e = np.empty(rows)
    e_new = np.empty(rows)
    J = np.empty((rows, 6))
    H = np.empty((6, 6))
    g = np.empty(6)
    L = np.zeros((6, 6))
    step = np.zeros(6)
    R_new = np.empty((3, 3))
    t_new = np.empty(3)
    cost = _residuals(model_id, lens, points, px, sigma, R, t, e)
    if cost == np.inf:
        return np.inf, 0, False
    damping = 1e-6
    last = np.inf
    is_stale = True
    for iteration in range(max_iterations):
        if is_stale:
            if not numeric_jacobian(model_id, lens, points, px, sigma, R, t, J):
                return cost, iteration, False
            for j in range(6):
                g[j] = 0.0
                for i in range(rows):
                    g[j] -= J[i, j] * e[i]
                for k in range(j + 1):
                    total = 0.0
                    for i in range(rows):
                        total += J[i, j] * J[i, k]
                    H[j, k] = total
                    H[k, j] = total
            is_stale = False
        if not solve_damped(H, g, damping, step, L):
            damping = max(10.0 * damping, 1e-6)
            if damping > 1e10:
                return cost, iteration + 1, False
            continue
        size = abs(step[0]) + abs(step[1]) + abs(step[2])
        size += (abs(step[3]) + abs(step[4]) + abs(step[5])) / (abs(t[0]) + abs(t[1]) + abs(t[2]))
        turn_and_shift(R, t, step, R_new, t_new)
        new_cost = _residuals(model_id, lens, points, px, sigma, R_new, t_new, e_new)
        if new_cost <= cost + _ROUNDING * cost + _ROUNDING_CHI2:
            for i in range(3):
                t[i] = t_new[i]
                for j in range(3):
                    R[i, j] = R_new[i, j]
            e, e_new = e_new, e
            cost = new_cost
            is_stale = True
            damping = max(damping * 0.1, 1e-12)
            if size < _REMAINDER or (size < 1e-6 and last < 1.0 and size * size < _REMAINDER * (last - size)):
                return cost, iteration + 1, True
            last = size
        else:
            if size < 1e-9:
                return cost, iteration + 1, True
            damping = max(damping * 10.0, 1e-4)
            last = np.inf
            if damping > 1e10:
                return cost, iteration + 1, False
    return cost, max_iterations, False


@compiled
def refine_many_numerically(
    model_id: int, lens: FloatArray, points: FloatArray, px: FloatArray, sigma: FloatArray, R: FloatArray,
    t: FloatArray, max_iterations: int,
) -> None:  # fmt: skip
    """Refine many: px (N, n, 2), R (N, 3, 3) and t (N, 3), in place; the loop the baseline is timed in."""
    for i in range(px.shape[0]):
        refine_numerically(model_id, lens, points, px[i], sigma, R[i], t[i], max_iterations)


solve = refining(refine_numerically)
