"""The uVGS-2 solver with Powell's dogleg in place of Levenberg-Marquardt: the same minimum along another path."""

from __future__ import annotations

from math import sqrt

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
def _dogleg_step(H: FloatArray, g: FloatArray, newton: FloatArray, radius: float, step: FloatArray) -> float:
    """The dogleg step within a radius, lengths measured by the diagonal of H; returns its length.

    Source: J. Nocedal, S. Wright, Numerical Optimization, section 4.1.
    """
    newton_length = 0.0
    gg = 0.0
    gHg = 0.0
    cauchy_length = 0.0
    for i in range(6):
        newton_length += H[i, i] * newton[i] * newton[i]
        gg += g[i] * g[i] / H[i, i]
        for j in range(6):
            gHg += g[i] / H[i, i] * H[i, j] * g[j] / H[j, j]
    newton_length = sqrt(newton_length)
    if newton_length <= radius:
        for i in range(6):
            step[i] = newton[i]
        return newton_length
    along = gg / gHg
    cauchy_length = along * sqrt(gg)
    if cauchy_length >= radius:
        for i in range(6):
            step[i] = radius / sqrt(gg) * g[i] / H[i, i]
        return radius
    # From the Cauchy point towards the Gauss-Newton point until the border: a quadratic in the share.
    a = 0.0
    b = 0.0
    for i in range(6):
        cauchy = along * g[i] / H[i, i]
        leg = newton[i] - cauchy
        a += H[i, i] * leg * leg
        b += H[i, i] * cauchy * leg
    c = cauchy_length * cauchy_length - radius * radius
    share = -c / (b + sqrt(max(b * b - a * c, 0.0)))
    for i in range(6):
        cauchy = along * g[i] / H[i, i]
        step[i] = cauchy + share * (newton[i] - cauchy)
    return radius


@compiled
def refine_pose_dogleg(
    model_id: int,
    lens: FloatArray,
    points: FloatArray,
    px: FloatArray,
    sigma: FloatArray,
    R: FloatArray,
    t: FloatArray,
    max_iterations: int,
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

    Returns:
        Chi-square, steps tried, whether it converged.

    Source: section 2.5 of the uVGS-2 paper names Dogleg beside Levenberg-Marquardt.
    """
    H = np.empty((6, 6))
    g = np.empty(6)
    H_new = np.empty((6, 6))
    g_new = np.empty(6)
    L = np.empty((6, 6))
    newton = np.empty(6)
    step = np.empty(6)
    residual = np.empty((points.shape[0], 2))
    R_new = np.empty((3, 3))
    t_new = np.empty(3)
    cost = normal_equations(model_id, lens, points, px, sigma, R, t, t, H, g, residual)
    if cost == np.inf:
        return np.inf, 0, False
    radius = np.inf
    for iteration in range(max_iterations):
        damping = 1e-12
        while not solve_damped(H, g, damping, newton, L):
            damping = max(10.0 * damping, 1e-9)
            if damping > 1e10:
                return cost, iteration + 1, False
        length = _dogleg_step(H, g, newton, radius, step)
        size = abs(step[0]) + abs(step[1]) + abs(step[2])
        size += (abs(step[3]) + abs(step[4]) + abs(step[5])) / (abs(t[0]) + abs(t[1]) + abs(t[2]))
        promised = 0.0
        for i in range(6):
            promised += 2.0 * g[i] * step[i]
            for j in range(6):
                promised -= step[i] * H[i, j] * step[j]
        turn_and_shift(R, t, step, R_new, t_new)
        new_cost = normal_equations(model_id, lens, points, px, sigma, R_new, t_new, t_new, H_new, g_new, residual)
        if new_cost <= cost + _ROUNDING * cost + _ROUNDING_CHI2:
            # A gain that rounding can hide says nothing about the model, so the radius is left alone.
            is_telling = promised > 1e-9 * cost + _ROUNDING_CHI2
            kept = (cost - new_cost) / promised if is_telling else 1.0
            for i in range(3):
                t[i] = t_new[i]
                for j in range(3):
                    R[i, j] = R_new[i, j]
            H, H_new = H_new, H
            g, g_new = g_new, g
            cost = new_cost
            if size < _REMAINDER:
                return cost, iteration + 1, True
            if kept > 0.75:
                radius = max(radius, 3.0 * length)
            elif kept < 0.25:
                radius = 0.5 * length
        else:
            if size < 1e-9:
                return cost, iteration + 1, True
            radius = 0.25 * length
    return cost, max_iterations, False


solve = refining(refine_pose_dogleg)
