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
    h00 = h10 = h11 = h20 = h21 = h22 = 0.0
    h30 = h31 = h32 = h33 = h40 = h41 = h42 = h43 = h44 = 0.0
    h50 = h51 = h52 = h53 = h54 = h55 = 0.0
    g0 = g1 = g2 = g3 = g4 = g5 = 0.0
    chi2 = 0.0
    for i in range(points.shape[0]):
        x = R[0, 0] * points[i, 0] + R[0, 1] * points[i, 1] + R[0, 2] * points[i, 2] + t[0]
        y = R[1, 0] * points[i, 0] + R[1, 1] * points[i, 1] + R[1, 2] * points[i, 2] + t[1]
        z = R[2, 0] * points[i, 0] + R[2, 1] * points[i, 1] + R[2, 2] * points[i, 2] + t[2]
        u, v, is_valid, ux, uy, uz, vx, vy, vz = project_point_with_jacobian(model_id, lens, x, y, z)
        if not is_valid:
            return np.inf
        qx = x - pivot[0]
        qy = y - pivot[1]
        qz = z - pivot[2]
        residual[i, 0] = px[i, 0] - u
        residual[i, 1] = px[i, 1] - v
        whiten = 1.0 / sigma[i]
        for axis in range(2):
            if axis == 0:
                d, e, f = whiten * ux, whiten * uy, whiten * uz
                r = whiten * (px[i, 0] - u)
            else:
                d, e, f = whiten * vx, whiten * vy, whiten * vz
                r = whiten * (px[i, 1] - v)
            a = f * qy - e * qz
            b = d * qz - f * qx
            c = e * qx - d * qy
            chi2 += r * r
            g0 += a * r
            g1 += b * r
            g2 += c * r
            g3 += d * r
            g4 += e * r
            g5 += f * r
            h00 += a * a
            h10 += b * a
            h11 += b * b
            h20 += c * a
            h21 += c * b
            h22 += c * c
            h30 += d * a
            h31 += d * b
            h32 += d * c
            h33 += d * d
            h40 += e * a
            h41 += e * b
            h42 += e * c
            h43 += e * d
            h44 += e * e
            h50 += f * a
            h51 += f * b
            h52 += f * c
            h53 += f * d
            h54 += f * e
            h55 += f * f
    g[0], g[1], g[2], g[3], g[4], g[5] = g0, g1, g2, g3, g4, g5
    H[0, 0], H[1, 1], H[2, 2], H[3, 3], H[4, 4], H[5, 5] = h00, h11, h22, h33, h44, h55
    H[0, 1] = H[1, 0] = h10
    H[0, 2] = H[2, 0] = h20
    H[1, 2] = H[2, 1] = h21
    H[0, 3] = H[3, 0] = h30
    H[1, 3] = H[3, 1] = h31
    H[2, 3] = H[3, 2] = h32
    H[0, 4] = H[4, 0] = h40
    H[1, 4] = H[4, 1] = h41
    H[2, 4] = H[4, 2] = h42
    H[3, 4] = H[4, 3] = h43
    H[0, 5] = H[5, 0] = h50
    H[1, 5] = H[5, 1] = h51
    H[2, 5] = H[5, 2] = h52
    H[3, 5] = H[5, 3] = h53
    H[4, 5] = H[5, 4] = h54
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
