"""Compiled parts of a pose's doubt, and what the perspective of a shining disc does to its centroid."""

from __future__ import annotations

from math import sqrt

import numpy as np

from uvgs_bench.camera.lens_kernels import project_point, project_points_with_jacobians
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.pose_kernels import normal_equations, solve_damped
from uvgs_bench.sensor.solvers.uvgs_lm import refine_pose


@compiled
def disc_shift(
    model_id: int,
    lens: FloatArray,
    points: FloatArray,
    axes: FloatArray,
    radii: FloatArray,
    R: FloatArray,
    t: FloatArray,
    shift: FloatArray,
) -> None:
    """How far the centroid of each projected disc lies from the projection of its centre.

    The nearer half of a tilted disc looks larger and brighter. Four points stand for the disc: they have its second
    moments. A surface that shines alike in all directions sends ``cos / d^2`` of its light to the camera, and the
    cosine goes with 1/d, because the distance of the camera from the plane of the disc is the same for all its points.

    Args:
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        points: Centres of the discs, beacon frame, shape (n, 3), m.
        axes: Their normals, beacon frame, shape (n, 3).
        radii: Their radii, shape (n,), m; 0 for none.
        R: Rotation camera_from_beacon, shape (3, 3).
        t: Translation, shape (3,), m.
        shift: Output, shape (n, 2), px.
    """
    a = np.empty(3)
    c = np.empty(3)
    side = np.empty(3)
    p = np.empty(3)
    for i in range(points.shape[0]):
        shift[i, 0] = 0.0
        shift[i, 1] = 0.0
        if radii[i] <= 0.0:
            continue
        for k in range(3):
            a[k] = R[k, 0] * axes[i, 0] + R[k, 1] * axes[i, 1] + R[k, 2] * axes[i, 2]
            c[k] = R[k, 0] * points[i, 0] + R[k, 1] * points[i, 1] + R[k, 2] * points[i, 2] + t[k]
        first = 0 if abs(a[0]) < 0.7 else 1
        for k in range(3):
            side[k] = (1.0 if k == first else 0.0) - a[first] * a[k]
        length = sqrt(side[0] ** 2 + side[1] ** 2 + side[2] ** 2)
        if not length > 0.0:
            continue
        u0, v0, ok = project_point(model_id, lens, c[0], c[1], c[2])
        weight = mean_u = mean_v = 0.0
        for corner in range(4):
            reach = radii[i] / sqrt(2.0) * (1.0 if corner % 2 == 0 else -1.0)
            for k in range(3):
                if corner < 2:
                    p[k] = c[k] + reach * side[k] / length
                else:
                    e = side[(k + 1) % 3] * a[(k + 2) % 3] - side[(k + 2) % 3] * a[(k + 1) % 3]
                    p[k] = c[k] + reach * e / length
            u, v, is_seen = project_point(model_id, lens, p[0], p[1], p[2])
            ok = ok and is_seen
            w = (p[0] ** 2 + p[1] ** 2 + p[2] ** 2) ** -1.5
            weight += w
            mean_u += w * u
            mean_v += w * v
        if ok:
            shift[i, 0] = mean_u / weight - u0
            shift[i, 1] = mean_v / weight - v0


@compiled
def fit_leds(
    model_id: int,
    lens: FloatArray,
    points: FloatArray,
    axes: FloatArray,
    radii: FloatArray,
    px: FloatArray,
    sigma: FloatArray,
    R: FloatArray,
    t: FloatArray,
    max_iterations: int,
    shift_doubt: float,
    H: FloatArray,
    residual: FloatArray,
) -> tuple[float, int, bool]:
    """Least squares pose of named LEDs, freed of the perspective of their discs as seen from a first solution.

    Args:
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        points: LED positions, shape (n, 3), m.
        axes: Emission axes, shape (n, 3).
        radii: LED radii, shape (n,), m; 0 where unknown.
        px: Centroids, freed of the shift in place, shape (n, 2), raw px.
        sigma: Their deviations, widened by the doubt about the shift in place, shape (n,), px.
        R: Start and result, shape (3, 3).
        t: Start and result, shape (3,), m.
        max_iterations: Most steps of each of the two solutions.
        shift_doubt: Deviation of the shift as a fraction of it.
        H: Output, information of the left tangent, shape (6, 6).
        residual: Output, observed minus projected, shape (n, 2), px.

    Returns:
        Chi-square, steps of the second solution, whether both converged.
    """
    chi2, steps, converged = refine_pose(model_id, lens, points, px, sigma, R, t, max_iterations, np.inf)
    is_disc = False
    for i in range(points.shape[0]):
        is_disc = is_disc or radii[i] > 0.0
    if converged and is_disc:
        shift = np.empty((points.shape[0], 2))
        disc_shift(model_id, lens, points, axes, radii, R, t, shift)
        for i in range(points.shape[0]):
            px[i, 0] -= shift[i, 0]
            px[i, 1] -= shift[i, 1]
            sigma[i] = sqrt(sigma[i] ** 2 + shift_doubt**2 * (shift[i, 0] ** 2 + shift[i, 1] ** 2))
        chi2, steps, converged = refine_pose(model_id, lens, points, px, sigma, R, t, max_iterations, np.inf)
    chi2 = normal_equations(model_id, lens, points, px, sigma, R, t, np.zeros(3), H, np.empty(6), residual)
    return chi2, steps, converged and chi2 < np.inf


@compiled
def pose_covariances(
    model_id: int,
    lens: FloatArray,
    points: FloatArray,
    sigma: FloatArray,
    R: FloatArray,
    t: FloatArray,
    information: FloatArray,
    beacon_m2: FloatArray,
    calibration: FloatArray,
    noise: FloatArray,
    by_beacon: FloatArray,
    by_calibration: FloatArray,
) -> bool:
    """Covariance of the left tangent (omega, v) from centroid noise, from the LED positions and from the lens.

    With the gain ``G = H^-1 J^T W`` the pose moves by ``-G d_px`` when the projections move by d_px.

    Args:
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        points: LEDs used, shape (n, 3), m.
        sigma: Centroid deviations, shape (n,), px.
        R: Rotation camera_from_beacon, shape (3, 3).
        t: Translation, shape (3,), m.
        information: J^T W J, shape (6, 6).
        beacon_m2: Covariance of these LEDs, shape (3n, 3n), m^2, or (0, 0).
        calibration: Covariance of the lens parameters, shape (P, P), or (0, 0).
        noise: Output, shape (6, 6).
        by_beacon: Output, shape (6, 6).
        by_calibration: Output, shape (6, 6).

    Returns:
        False when the information cannot be inverted.
    """
    n = points.shape[0]
    L = np.zeros((6, 6))
    unit = np.zeros(6)
    column = np.zeros(6)
    for k in range(6):
        unit[:] = 0.0
        unit[k] = 1.0
        if not solve_damped(information, unit, 0.0, column, L):
            return False
        noise[:, k] = column
    for k in range(6):
        for j in range(k):
            noise[k, j] = noise[j, k] = 0.5 * (noise[k, j] + noise[j, k])
    by_beacon[:] = 0.0
    by_calibration[:] = 0.0
    if beacon_m2.shape[0] == 0 and calibration.shape[0] == 0:
        return True
    p = np.empty((n, 3))
    for i in range(n):
        for k in range(3):
            p[i, k] = R[k, 0] * points[i, 0] + R[k, 1] * points[i, 1] + R[k, 2] * points[i, 2] + t[k]
    _, by_point, by_lens = project_points_with_jacobians(model_id, lens, p)
    lenses = calibration.shape[0]
    moved_by_led = np.zeros((6, 3 * n))
    moved_by_lens = np.zeros((6, lenses))
    gain = np.empty(6)
    for i in range(n):
        for row in range(2):
            d, e, f = by_point[i, row, 0], by_point[i, row, 1], by_point[i, row, 2]
            a = f * p[i, 1] - e * p[i, 2]
            b = d * p[i, 2] - f * p[i, 0]
            c = e * p[i, 0] - d * p[i, 1]
            for k in range(6):
                gain[k] = (
                    noise[k, 0] * a + noise[k, 1] * b + noise[k, 2] * c
                    + noise[k, 3] * d + noise[k, 4] * e + noise[k, 5] * f
                ) / (sigma[i] * sigma[i])  # fmt: skip
            for k in range(6):
                for j in range(3):
                    moved_by_led[k, 3 * i + j] += gain[k] * (d * R[0, j] + e * R[1, j] + f * R[2, j])
                for j in range(lenses):
                    moved_by_lens[k, j] += gain[k] * by_lens[i, row, j]
    if beacon_m2.shape[0] > 0:
        _add_square(moved_by_led, beacon_m2, by_beacon)
    if lenses > 0:
        _add_square(moved_by_lens, calibration, by_calibration)
    return True


@compiled
def _add_square(M: FloatArray, S: FloatArray, out: FloatArray) -> None:
    """``out += M S M^T`` for a symmetric S."""
    n = S.shape[0]
    for a in range(6):
        for j in range(n):
            total = 0.0
            for i in range(n):
                total += M[a, i] * S[i, j]
            for b in range(a + 1):
                out[a, b] += total * M[b, j]
    for a in range(6):
        for b in range(a):
            out[b, a] = out[a, b]
