"""P4P with unknown focal lengths: pose, focal length and aspect from four non-coplanar points, compiled.

It plays the role of Fa-P4P: eight measurements for eight unknowns, so every real solution fits exactly and noise is
never averaged. Principal point and distortion are taken from the lens.

Mathematics. With depths ``d_i`` and pixels ``m_i = (u_i, v_i, 1)`` from the principal point,
``d_i m_i = K (R P_i + t)``, ``K = diag(fx, fy, 1)``. Four non-coplanar points are an affine basis, so with the
gradients ``c_i`` of their barycentric coordinates (sum 0) ``sum d_i m_i c_i^T = K R``. Its rows are orthogonal: with
``G_ij = c_i . c_j`` the depths lie on three homogeneous quadrics ``d^T diag(m^a) G diag(m^b) d = 0``, (a, b) = (u, v),
(u, 1), (v, 1), which meet in at most eight points. The plane ``sum d = 4`` fixes the scale.

Source: the problem is that of Y. Guo, A Novel Solution to the P4P Problem for an Uncalibrated Camera, 2013.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.geometry.se3 import nearest_rotation
from uvgs_bench.sensor.quadrics import MOST_POINTS, intersect_quadrics
from uvgs_bench.sensor.solution import Solution

# Orthonormal basis of the plane sum d = 0, columns.
_ACROSS = 0.5 * np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
# Positive depths with sum 4 lie within this of (1, 1, 1, 1) along any direction.
_REACH = 3.5


@compiled
def _gradients(points: FloatArray, c: FloatArray) -> float:
    """Gradients of the barycentric coordinates of four points, c shape (4, 3). Returns their size, 0 when coplanar."""
    E = np.empty((3, 3))
    size = 0.0
    for i in range(3):
        for j in range(3):
            E[i, j] = points[i + 1, j] - points[0, j]
            size = max(size, abs(E[i, j]))
    for i in range(3):
        a = (i + 1) % 3
        b = (i + 2) % 3
        for j in range(3):
            k = (j + 1) % 3
            m = (j + 2) % 3
            c[i + 1, j] = E[a, k] * E[b, m] - E[a, m] * E[b, k]
    volume = E[0, 0] * c[1, 0] + E[0, 1] * c[1, 1] + E[0, 2] * c[1, 2]
    if not abs(volume) > 1e-9 * size * size * size:
        return 0.0
    for j in range(3):
        c[0, j] = 0.0
        for i in range(1, 4):
            c[i, j] /= volume
            c[0, j] -= c[i, j]
    return size


@compiled
def solve_depths(points: FloatArray, m: FloatArray, depths: FloatArray) -> int:
    """Depth ratios that make the rows of ``K R`` orthogonal.

    Args:
        points: Beacon points, shape (4, 3), not coplanar, any length unit.
        m: Coordinates from the principal point, shape (4, 2), of order 1.
        depths: Output, positive depths with sum 4, shape (8, 4).

    Returns:
        Number of solutions, 0 to 8; 0 for coplanar points.
    """
    c = np.empty((4, 3))
    size = _gradients(points, c)
    if size == 0.0:
        return 0
    u0 = 0.25 * (m[0, 0] + m[1, 0] + m[2, 0] + m[3, 0])
    v0 = 0.25 * (m[0, 1] + m[1, 1] + m[2, 1] + m[3, 1])
    spread = 0.0
    for i in range(4):
        spread = max(spread, max(abs(m[i, 0] - u0), abs(m[i, 1] - v0)))
    if not spread > 0.0:
        return 0
    D = np.empty((4, 4))
    T = np.empty((4, 4))
    Q = np.empty((3, 4, 4))
    for k in range(3):
        for i in range(4):
            for j in range(4):
                # Scaled by the size so that G is of order 1.
                G = size * size * (c[i, 0] * c[j, 0] + c[i, 1] * c[j, 1] + c[i, 2] * c[j, 2])
                if k == 0:
                    f = 0.5 * (m[i, 0] * m[j, 1] + m[j, 0] * m[i, 1])
                elif k == 1:
                    f = 0.5 * (m[i, 0] + m[j, 0])
                else:
                    f = 0.5 * (m[i, 1] + m[j, 1])
                D[i, j] = G * f
        # d = 1 + across w
        for i in range(4):
            for j in range(4):
                T[i, j] = 0.0
                for p in range(4):
                    T[i, j] += D[i, p] * (_ACROSS[p, j] if j < 3 else 1.0)
        scale = 0.0
        for i in range(4):
            for j in range(4):
                total = 0.0
                for p in range(4):
                    total += (_ACROSS[p, i] if i < 3 else 1.0) * T[p, j]
                Q[k, i, j] = total
                scale = max(scale, abs(total))
        if scale == 0.0:
            return 0
        for i in range(4):
            for j in range(4):
                Q[k, i, j] /= scale
    w = np.empty((MOST_POINTS, 3))
    count = 0
    for s in range(intersect_quadrics(Q, _REACH, w)):
        is_in_front = True
        for i in range(4):
            d = 1.0 + _ACROSS[i, 0] * w[s, 0] + _ACROSS[i, 1] * w[s, 1] + _ACROSS[i, 2] * w[s, 2]
            depths[count, i] = d
            is_in_front = is_in_front and d > 0.0
        if is_in_front:
            count += 1
    return count


@compiled
def solve_p4pf(points: FloatArray, m: FloatArray, Rs: FloatArray, ts: FloatArray, focal: FloatArray) -> int:
    """Poses and focal lengths that put four points on four pixels.

    Args:
        points: Beacon points, shape (4, 3), m, not coplanar.
        m: Coordinates from the principal point, shape (4, 2), of order 1 (pixels over a nominal focal length).
        Rs: Output, rotations camera_from_beacon to rounding, shape (8, 3, 3).
        ts: Output, translations, shape (8, 3), m.
        focal: Output, fx and fy in units of ``m``, shape (8, 2).

    Returns:
        Number of solutions; all have positive depths and focal lengths, and are proper rotations.
    """
    depths = np.empty((MOST_POINTS, 4))
    c = np.empty((4, 3))
    count = 0
    if _gradients(points, c) == 0.0:
        return 0
    for s in range(solve_depths(points, m, depths)):
        d = depths[s]
        R = Rs[count]
        for j in range(3):
            R[0, j] = R[1, j] = R[2, j] = 0.0
            for i in range(4):
                R[0, j] += d[i] * m[i, 0] * c[i, j]
                R[1, j] += d[i] * m[i, 1] * c[i, j]
                R[2, j] += d[i] * c[i, j]
        n0 = sqrt(R[0, 0] ** 2 + R[0, 1] ** 2 + R[0, 2] ** 2)
        n1 = sqrt(R[1, 0] ** 2 + R[1, 1] ** 2 + R[1, 2] ** 2)
        n2 = sqrt(R[2, 0] ** 2 + R[2, 1] ** 2 + R[2, 2] ** 2)
        if not (n0 > 0.0 and n1 > 0.0 and n2 > 1e-12 * (n0 + n1)):
            continue
        for j in range(3):
            R[0, j] /= n0
            R[1, j] /= n1
            R[2, j] /= n2
        det = (
            R[0, 0] * (R[1, 1] * R[2, 2] - R[1, 2] * R[2, 1]) - R[0, 1] * (R[1, 0] * R[2, 2] - R[1, 2] * R[2, 0])
            + R[0, 2] * (R[1, 0] * R[2, 1] - R[1, 1] * R[2, 0])
        )  # fmt: skip
        if det < 0.0:
            continue
        fx = n0 / n2
        fy = n1 / n2
        focal[count, 0] = fx
        focal[count, 1] = fy
        for i in range(3):
            turned = R[i, 0] * points[0, 0] + R[i, 1] * points[0, 1] + R[i, 2] * points[0, 2]
            ray = 1.0 if i == 2 else (m[0, 0] / fx if i == 0 else m[0, 1] / fy)
            ts[count, i] = d[0] / n2 * ray - turned
        count += 1
    return count


@dataclass(frozen=True, slots=True, eq=False)
class FocalPose:
    """One solution with its focal lengths.

    Args:
        camera_from_beacon: The pose.
        fx_px: Focal length along columns, px.
        fy_px: Focal length along rows, px.
    """

    camera_from_beacon: Pose
    fx_px: float
    fy_px: float


def find_focal_poses(lens: Lens, points_m: FloatArray, px: FloatArray) -> tuple[FocalPose, ...]:
    """All solutions, the one whose aspect is nearest to that of the lens first.

    Args:
        lens: Gives principal point, distortion and nominal aspect; its focal lengths only scale the numbers.
        points_m: Beacon points, shape (n, 3), m; the first four are used.
        px: Their centroids, shape (n, 2), raw px.

    Returns:
        Zero to eight solutions; none for coplanar points or pixels without a ray.
    """
    rays = lens.unproject(px[:4])
    if not np.isfinite(rays).all() or not (rays[:, 2] > 0.0).all():
        return ()
    Rs, ts, focal = np.empty((MOST_POINTS, 3, 3)), np.empty((MOST_POINTS, 3)), np.empty((MOST_POINTS, 2))
    m = np.ascontiguousarray(rays[:, :2] / rays[:, 2:])
    count = solve_p4pf(np.array(points_m[:4], dtype=np.float64), m, Rs, ts, focal)
    order = np.argsort(np.abs(np.log(focal[:count, 0] / focal[:count, 1])), kind="stable")
    return tuple(
        FocalPose(
            Pose(nearest_rotation(Rs[i]), ts[i], "camera", "beacon"),
            float(focal[i, 0]) * lens.fx_px,
            float(focal[i, 1]) * lens.fy_px,
        )
        for i in order
    )


def solve(
    lens: Lens, points_m: FloatArray, px: FloatArray, sigma_px: FloatArray, start: Pose, max_iterations: int
) -> Solution:
    """The solution whose aspect is nearest to that of the lens; its focal lengths are forgotten.

    Args:
        lens: The lens.
        points_m: Beacon points, shape (n, 3), m; the first four are used.
        px: Observed centroids, shape (n, 2), raw px.
        sigma_px: Their deviations, shape (n,), px.
        start: Answered, not converged, when there is no solution; otherwise not used.
        max_iterations: Not used.

    Returns:
        The solution; residual and chi-square are those of the pose under the lens as given.
    """
    found = find_focal_poses(lens, points_m, px)
    if not found:
        return Solution.at(lens, points_m, px, sigma_px, start, 0, False)
    return Solution.at(lens, points_m, px, sigma_px, found[0].camera_from_beacon, 0, True)
