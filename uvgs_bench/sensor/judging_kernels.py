"""Compiled end of every solution: fit, covariances and the tests a pose must pass, in one call."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.doubt_kernels import fit_leds, pose_covariances

# What the tests say.
BELIEVED, NOT_CONVERGED, BEHIND_CAMERA, NOT_FACING, OUT_OF_RANGE, RMS_TOO_LARGE, CHI2_TOO_LARGE, DEGENERATE = range(8)
# Places in the table of limits.
FOCAL_PX, SEES_BEHIND, MIN_RANGE_M, MAX_RANGE_M, MODEL_ERROR_PX, MAX_RMS_PX, MAX_CHI2_PER_DOF, LIMIT_COUNT = range(8)
# Below this the inverse keeps no digit: far beyond any real view of four LEDs.
_LEAST_EIGENVALUE = 1e-13


@compiled
def judge_fit(
    model_id: int,
    lens: FloatArray,
    points: FloatArray,
    axes: FloatArray,
    cos_limit: FloatArray,
    beacon_m2: FloatArray,
    calibration: FloatArray,
    limits: FloatArray,
    sigma: FloatArray,
    R: FloatArray,
    t: FloatArray,
    information: FloatArray,
    residual: FloatArray,
    converged: bool,
    noise: FloatArray,
    by_beacon: FloatArray,
    by_calibration: FloatArray,
) -> tuple[int, float, float]:
    """Covariances of a solution, and whether it is believed: the first test it fails.

    Args:
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        points: LEDs used, shape (k, 3), m.
        axes: Their emission axes, shape (k, 3).
        cos_limit: Cosine of the widest visible angle of each, shape (k,); -2 for LEDs that shine everywhere.
        beacon_m2: Covariance of these LEDs, shape (3k, 3k), m^2, or (0, 0).
        calibration: Covariance of the lens parameters, shape (P, P), or (0, 0).
        limits: Shape (LIMIT_COUNT,).
        sigma: Centroid deviations, shape (k,), px.
        R: Rotation camera_from_beacon, shape (3, 3).
        t: Translation, shape (3,), m.
        information: J^T W J of the left tangent, shape (6, 6).
        residual: Observed minus projected, shape (k, 2), px.
        converged: Whether the solver says it arrived.
        noise: Output, shape (6, 6).
        by_beacon: Output, shape (6, 6).
        by_calibration: Output, shape (6, 6).

    Returns:
        Which test fails, or ``BELIEVED``, and the numbers it failed by: least depth (m); index of the LED; range (m);
        rms (px); chi-square and rms.
    """
    n = points.shape[0]
    is_determined = pose_covariances(
        model_id, lens, points, sigma, R, t, information, beacon_m2, calibration, noise, by_beacon, by_calibration
    )
    if not converged:
        return NOT_CONVERGED, 0.0, 0.0
    nearest = np.inf
    hidden = -1
    chi2 = 0.0
    square = 0.0
    for i in range(n):
        depth = 0.0
        dot = 0.0
        norm = 0.0
        for k in range(3):
            p = R[k, 0] * points[i, 0] + R[k, 1] * points[i, 1] + R[k, 2] * points[i, 2] + t[k]
            d = R[k, 0] * axes[i, 0] + R[k, 1] * axes[i, 1] + R[k, 2] * axes[i, 2]
            dot -= d * p
            norm += p * p
            depth = p
        nearest = min(nearest, depth)
        if hidden < 0 and dot / sqrt(norm) < cos_limit[i]:
            hidden = i
        variance = sigma[i] * sigma[i] + limits[MODEL_ERROR_PX] * limits[MODEL_ERROR_PX]
        if beacon_m2.shape[0] > 0:
            spread = (beacon_m2[3 * i, 3 * i] + beacon_m2[3 * i + 1, 3 * i + 1] + beacon_m2[3 * i + 2, 3 * i + 2]) / 3.0
            variance += spread * limits[FOCAL_PX] * limits[FOCAL_PX] / norm
        off = residual[i, 0] * residual[i, 0] + residual[i, 1] * residual[i, 1]
        square += off
        chi2 += off / variance
    if limits[SEES_BEHIND] == 0.0 and nearest <= 0.0:
        return BEHIND_CAMERA, nearest, 0.0
    if hidden >= 0:
        return NOT_FACING, float(hidden), 0.0
    range_m = sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    if not (range_m >= limits[MIN_RANGE_M] and range_m <= limits[MAX_RANGE_M]):
        return OUT_OF_RANGE, range_m, 0.0
    rms = sqrt(square / (2 * n))
    if rms > limits[MAX_RMS_PX]:
        return RMS_TOO_LARGE, rms, 0.0
    if n > 3 and chi2 > limits[MAX_CHI2_PER_DOF] * (2 * n - 6):
        return CHI2_TOO_LARGE, chi2, rms
    # Scaled to a unit diagonal, so that radians and metres do not count. The least eigenvalue lies between one and six
    # times one over the trace of the inverse.
    trace = 0.0
    for k in range(6):
        trace += noise[k, k] * information[k, k]
    if not is_determined or not trace * _LEAST_EIGENVALUE < 1.0:
        return DEGENERATE, 0.0, 0.0
    return BELIEVED, 0.0, 0.0


@compiled
def gather_leds(
    seen: NDArray[np.int64],
    leds: FloatArray,
    axes: FloatArray,
    cos_limit: FloatArray,
    beacon_m2: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The rows of the LEDs that are seen: positions (m), axes, cones, covariance (m^2; (0, 0) stays)."""
    n = seen.shape[0]
    points = np.empty((n, 3))
    normals = np.empty((n, 3))
    cones = np.empty(n)
    width = 3 * n if beacon_m2.shape[0] > 0 else 0
    spread = np.empty((width, width))
    for i in range(n):
        for k in range(3):
            points[i, k] = leds[seen[i], k]
            normals[i, k] = axes[seen[i], k]
        cones[i] = cos_limit[seen[i]]
    for i in range(width):
        for j in range(width):
            spread[i, j] = beacon_m2[3 * seen[i // 3] + i % 3, 3 * seen[j // 3] + j % 3]
    return points, normals, cones, spread


@compiled
def fit_and_judge(
    model_id: int,
    lens: FloatArray,
    leds: FloatArray,
    axes: FloatArray,
    radii: FloatArray,
    cos_limit: FloatArray,
    beacon_m2: FloatArray,
    calibration: FloatArray,
    limits: FloatArray,
    seen: NDArray[np.int64],
    max_iterations: int,
    shift_doubt: float,
    px: FloatArray,
    sigma: FloatArray,
    R: FloatArray,
    t: FloatArray,
    led_px: FloatArray,
    led_residual: FloatArray,
    noise: FloatArray,
    by_beacon: FloatArray,
    by_calibration: FloatArray,
) -> tuple[int, int, float, float, float]:
    """``fit_leds`` and ``judge_fit`` for the LEDs that are seen.

    Args:
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        leds: All LED positions, shape (n, 3), m.
        axes: All emission axes, shape (n, 3).
        radii: All LED radii, shape (n,), m; 0 where unknown.
        cos_limit: All cones, shape (n,).
        beacon_m2: Covariance of the LEDs, shape (3n, 3n), m^2, or (0, 0).
        calibration: Covariance of the lens parameters, shape (P, P), or (0, 0).
        limits: Shape (LIMIT_COUNT,).
        seen: Indices of the LEDs used, shape (k,).
        max_iterations: As for ``fit_leds``.
        shift_doubt: As for ``fit_leds``.
        px: As for ``fit_leds``, shape (k, 2), in place.
        sigma: As for ``fit_leds``, shape (k,), in place.
        R: Start and result, shape (3, 3).
        t: Start and result, shape (3,), m.
        led_px: Output, ``px`` in the order of all LEDs, NaN where unseen, shape (n, 2).
        led_residual: Output, observed minus projected, NaN where unseen, shape (n, 2), px.
        noise: Output, shape (6, 6).
        by_beacon: Output, shape (6, 6).
        by_calibration: Output, shape (6, 6).

    Returns:
        What ``judge_fit`` says, the steps taken, its two numbers, and the rms of the residual, px.
    """
    points, normals, cones, spread = gather_leds(seen, leds, axes, cos_limit, beacon_m2)
    sizes = np.empty(seen.shape[0])
    for i in range(seen.shape[0]):
        sizes[i] = radii[seen[i]]
    information = np.empty((6, 6))
    residual = np.full((seen.shape[0], 2), np.nan)
    _, steps, converged = fit_leds(
        model_id, lens, points, normals, sizes, px, sigma, R, t, max_iterations, shift_doubt, information, residual
    )
    verdict, one, two = judge_fit(
        model_id, lens, points, normals, cones, spread, calibration, limits, sigma, R, t, information, residual,
        converged, noise, by_beacon, by_calibration,
    )  # fmt: skip
    led_px[:] = np.nan
    led_residual[:] = np.nan
    square = 0.0
    for i in range(seen.shape[0]):
        for k in range(2):
            led_px[seen[i], k] = px[i, k]
            led_residual[seen[i], k] = residual[i, k]
            square += residual[i, k] * residual[i, k]
    return verdict, steps, one, two, sqrt(square / (2 * seen.shape[0]))
