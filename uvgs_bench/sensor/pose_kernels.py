"""Compiled pieces every solver needs: residuals with their Jacobian through the exact lens, and a 6 x 6 solve."""

from __future__ import annotations

from math import cos, sin, sqrt

import numpy as np

from uvgs_bench.camera.lens_kernels import project_point_with_jacobian
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled


@compiled
def normal_equations(
    model_id: int,
    lens: FloatArray,
    points: FloatArray,
    px: FloatArray,
    sigma: FloatArray,
    R: FloatArray,
    t: FloatArray,
    pivot: FloatArray,
    H: FloatArray,
    g: FloatArray,
    residual: FloatArray,
) -> float:
    """Whitened normal equations of the reprojection error at a pose.

    The projected pixel moves by ``d_px/d_p [ -[p - pivot]^ | I ]`` with the twist (omega, v). Pivot 0 is the left
    update ``T <- exp(xi^) T``; pivot ``t`` turns about the beacon, which separates turning from shifting and makes
    damping meaningful.

    Args:
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        points: Beacon points, shape (n, 3), m.
        px: Observed centroids, shape (n, 2), raw px.
        sigma: Their deviations, shape (n,), px.
        R: Rotation camera_from_beacon, shape (3, 3).
        t: Translation, shape (3,), m.
        pivot: Centre of the turn, camera frame, shape (3,), m.
        H: Output, J^T W J, shape (6, 6).
        g: Output, J^T W (observed - projected), shape (6,), J of the projection.
        residual: Output, observed - projected, shape (n, 2), px.

    Returns:
        Chi-square, or inf when a point cannot be projected.

    Source: equations 2 to 4 of the uVGS-2 paper, with rotation first.
    """
    H[:] = 0.0
    g[:] = 0.0
    chi2 = 0.0
    row = np.empty(6)
    for i in range(points.shape[0]):
        a = R[0, 0] * points[i, 0] + R[0, 1] * points[i, 1] + R[0, 2] * points[i, 2]
        b = R[1, 0] * points[i, 0] + R[1, 1] * points[i, 1] + R[1, 2] * points[i, 2]
        c = R[2, 0] * points[i, 0] + R[2, 1] * points[i, 1] + R[2, 2] * points[i, 2]
        x = a + t[0]
        y = b + t[1]
        z = c + t[2]
        u, v, ok, ux, uy, uz, vx, vy, vz = project_point_with_jacobian(model_id, lens, x, y, z)
        if not ok:
            return np.inf
        qx = x - pivot[0]
        qy = y - pivot[1]
        qz = z - pivot[2]
        weight = 1.0 / (sigma[i] * sigma[i])
        for axis in range(2):
            if axis == 0:
                dx, dy, dz = ux, uy, uz
                e = px[i, 0] - u
            else:
                dx, dy, dz = vx, vy, vz
                e = px[i, 1] - v
            residual[i, axis] = e
            row[0] = dz * qy - dy * qz
            row[1] = dx * qz - dz * qx
            row[2] = dy * qx - dx * qy
            row[3] = dx
            row[4] = dy
            row[5] = dz
            chi2 += weight * e * e
            for j in range(6):
                scaled = weight * row[j]
                g[j] += scaled * e
                for k in range(j + 1):
                    H[j, k] += scaled * row[k]
    for j in range(6):
        for k in range(j):
            H[k, j] = H[j, k]
    return chi2


@compiled
def solve_damped(H: FloatArray, g: FloatArray, damping: float, step: FloatArray, L: FloatArray) -> bool:
    """Solve ``(H + damping diag(H)) step = g`` by Cholesky.

    Args:
        H: Symmetric matrix, shape (6, 6).
        g: Right side, shape (6,).
        damping: Relative damping, >= 0.
        step: Output, shape (6,).
        L: Scratch, shape (6, 6).

    Returns:
        False when the matrix is not positive definite.
    """
    for i in range(6):
        for j in range(i + 1):
            s = H[i, j]
            if i == j:
                s += damping * H[i, i]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > 1e-14 * H[i, i]:
                    return False
                L[i, i] = sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for i in range(6):
        s = g[i]
        for k in range(i):
            s -= L[i, k] * step[k]
        step[i] = s / L[i, i]
    for i in range(5, -1, -1):
        s = step[i]
        for k in range(i + 1, 6):
            s -= L[k, i] * step[k]
        step[i] = s / L[i, i]
    return True


@compiled
def turn_and_shift(R: FloatArray, t: FloatArray, step: FloatArray, R_new: FloatArray, t_new: FloatArray) -> None:
    """Turn a pose about the beacon's origin by the rotation vector step[:3], then shift it by step[3:].

    Args:
        R: Rotation, shape (3, 3).
        t: Translation, shape (3,), m.
        step: (omega, v), shape (6,), rad and m.
        R_new: Output, ``exp(omega^) R``.
        t_new: Output, ``t + v``.
    """
    wx, wy, wz = step[0], step[1], step[2]
    s2 = wx * wx + wy * wy + wz * wz
    if s2 < 1e-8:
        a = 1.0 - s2 / 6.0
        b = 0.5 - s2 / 24.0
    else:
        angle = sqrt(s2)
        a = sin(angle) / angle
        b = (1.0 - cos(angle)) / s2
    for j in range(3):
        x, y, z = R[0, j], R[1, j], R[2, j]
        cx = wy * z - wz * y
        cy = wz * x - wx * z
        cz = wx * y - wy * x
        R_new[0, j] = x + a * cx + b * (wy * cz - wz * cy)
        R_new[1, j] = y + a * cy + b * (wz * cx - wx * cz)
        R_new[2, j] = z + a * cz + b * (wx * cy - wy * cx)
    for i in range(3):
        t_new[i] = t[i] + step[3 + i]
