"""P3P by a conic pencil (Lambda Twist): up to four poses from three rays, compiled.

Source: M. Persson, K. Nordberg, Lambda Twist: An Accurate Fast Robust Perspective Three Point (P3P) Solver, ECCV 2018.
Written from the equations of the paper; the degenerate conic is parametrised by a basis of its plane, so that no
distance is singled out to divide by.
"""

from __future__ import annotations

from math import acos, cos, pi, sqrt

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled


@compiled
def _cubic_roots(b: float, c: float, d: float, roots: FloatArray) -> int:
    """Real roots of x^3 + b x^2 + c x + d, polished by Newton. Returns their number."""
    q = (b * b - 3.0 * c) / 9.0
    r = (b * (2.0 * b * b - 9.0 * c) + 27.0 * d) / 54.0
    if r * r < q * q * q:
        angle = acos(min(1.0, max(-1.0, r / sqrt(q * q * q))))
        size = -2.0 * sqrt(q)
        for i in range(3):
            roots[i] = size * cos((angle + 2.0 * pi * (i - 1)) / 3.0) - b / 3.0
        count = 3
    else:
        e = (abs(r) + sqrt(max(r * r - q * q * q, 0.0))) ** (1.0 / 3.0)
        if r > 0.0:
            e = -e
        roots[0] = e + (q / e if e != 0.0 else 0.0) - b / 3.0
        count = 1
    for i in range(count):
        x = roots[i]
        for _ in range(4):
            slope = c + x * (2.0 * b + 3.0 * x)
            if slope == 0.0:
                break
            x -= (d + x * (c + x * (b + x))) / slope
        roots[i] = x
    return count


@compiled
def _form(D: FloatArray, u: FloatArray, v: FloatArray) -> float:
    """u^T D v of symmetric D."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += u[i] * D[i, j] * v[j]
    return total


@compiled
def _eigenvector(D: FloatArray, value: float, out: FloatArray) -> bool:
    """Unit eigenvector of symmetric D: the longest cross product of two rows of ``D - value I``."""
    best = 0.0
    for k in range(3):
        i = (k + 1) % 3
        j = (k + 2) % 3
        a0 = D[i, 0] - (value if i == 0 else 0.0)
        a1 = D[i, 1] - (value if i == 1 else 0.0)
        a2 = D[i, 2] - (value if i == 2 else 0.0)
        b0 = D[j, 0] - (value if j == 0 else 0.0)
        b1 = D[j, 1] - (value if j == 1 else 0.0)
        b2 = D[j, 2] - (value if j == 2 else 0.0)
        c0 = a1 * b2 - a2 * b1
        c1 = a2 * b0 - a0 * b2
        c2 = a0 * b1 - a1 * b0
        size = c0 * c0 + c1 * c1 + c2 * c2
        if size > best:
            best = size
            norm = sqrt(size)
            out[0] = c0 / norm
            out[1] = c1 / norm
            out[2] = c2 / norm
    return best > 0.0


@compiled
def _polish(distances: FloatArray, b: FloatArray, a: FloatArray) -> None:
    """Three Newton steps on the cosine laws of the three distances."""
    for _ in range(3):
        x, y, z = distances[0], distances[1], distances[2]
        r0 = x * x + y * y - 2.0 * x * y * b[0] - a[0]
        r1 = x * x + z * z - 2.0 * x * z * b[1] - a[1]
        r2 = y * y + z * z - 2.0 * y * z * b[2] - a[2]
        p00 = 2.0 * (x - y * b[0])
        p01 = 2.0 * (y - x * b[0])
        p10 = 2.0 * (x - z * b[1])
        p12 = 2.0 * (z - x * b[1])
        p21 = 2.0 * (y - z * b[2])
        p22 = 2.0 * (z - y * b[2])
        det = -p00 * p12 * p21 - p01 * p10 * p22
        if det == 0.0:
            return
        distances[0] -= (-p12 * p21 * r0 - p01 * p22 * r1 + p01 * p12 * r2) / det
        distances[1] -= (-p10 * p22 * r0 + p00 * p22 * r1 - p00 * p12 * r2) / det
        distances[2] -= (p10 * p21 * r0 - p00 * p21 * r1 - p01 * p10 * r2) / det


@compiled
def solve_p3p(rays: FloatArray, points: FloatArray, Rs: FloatArray, ts: FloatArray) -> int:
    """Poses that put three points on three rays.

    Args:
        rays: Unit rays in the camera frame, shape (3, 3), one a row.
        points: Points in the beacon frame, shape (3, 3), m, one a row, not collinear.
        Rs: Output, rotations camera_from_beacon, shape (4, 3, 3).
        ts: Output, translations, shape (4, 3), m.

    Returns:
        Number of poses, 0 to 4; all have positive distances.
    """
    a = np.empty(3)
    b = np.empty(3)
    pairs = ((0, 1), (0, 2), (1, 2))
    for k in range(3):
        i, j = pairs[k]
        a[k] = 0.0
        b[k] = 0.0
        for c in range(3):
            a[k] += (points[i, c] - points[j, c]) ** 2
            b[k] += rays[i, c] * rays[j, c]
    # D1 = M12 a23 - M23 a12, D2 = M13 a23 - M23 a13: both vanish on the distances.
    D1 = np.zeros((3, 3))
    D2 = np.zeros((3, 3))
    scale = 1.0 / a[2]
    a12 = a[0] * scale
    a13 = a[1] * scale
    D1[0, 0] = 1.0
    D1[0, 1] = D1[1, 0] = -b[0]
    D1[1, 1] = 1.0 - a12
    D1[1, 2] = D1[2, 1] = a12 * b[2]
    D1[2, 2] = -a12
    D2[0, 0] = 1.0
    D2[0, 2] = D2[2, 0] = -b[1]
    D2[1, 1] = -a13
    D2[1, 2] = D2[2, 1] = a13 * b[2]
    D2[2, 2] = 1.0 - a13
    # det(D1 + x D2) as a cubic, by its values at 0, inf, 1, -1.
    d1 = _det(D1, D2, 1.0, 0.0)
    d2 = _det(D1, D2, 0.0, 1.0)
    plus = _det(D1, D2, 1.0, 1.0)
    minus = _det(D1, D2, 1.0, -1.0)
    c2 = 0.5 * (plus + minus) - d1
    c1 = 0.5 * (plus - minus) - d2
    if d2 == 0.0:
        return 0
    roots = np.empty(3)
    number = _cubic_roots(c2 / d2, c1 / d2, d1 / d2, roots)
    D0 = np.empty((3, 3))
    e1 = np.empty(3)
    e2 = np.empty(3)
    normal = np.empty(3)
    u = np.empty(3)
    v = np.empty(3)
    distances = np.empty(3)
    count = 0
    for r in range(number):
        x = roots[r]
        for i in range(3):
            for j in range(3):
                D0[i, j] = D1[i, j] + x * D2[i, j]
        trace = D0[0, 0] + D0[1, 1] + D0[2, 2]
        minors = (
            D0[0, 0] * D0[1, 1]
            - D0[0, 1] ** 2
            + D0[0, 0] * D0[2, 2]
            - D0[0, 2] ** 2
            + D0[1, 1] * D0[2, 2]
            - D0[1, 2] ** 2
        )
        # The eigenvalues besides 0 must have opposite signs for the conic to be two real planes.
        if minors >= 0.0:
            continue
        root = sqrt(trace * trace - 4.0 * minors)
        s1 = 0.5 * (trace + root)
        s2 = 0.5 * (trace - root)
        if not (_eigenvector(D0, s1, e1) and _eigenvector(D0, s2, e2)):
            continue
        ratio = sqrt(-s2 / s1)
        for sign in (-1.0, 1.0):
            for i in range(3):
                normal[i] = e1[i] + sign * ratio * e2[i]
            _plane_basis(normal, u, v)
            # On this plane D1 = -x D2: take the larger of the two forms.
            D = D2 if abs(x) < 1.0 else D1
            uu = _form(D, u, u)
            uv = _form(D, u, v)
            vv = _form(D, v, v)
            disc = uv * uv - uu * vv
            if disc < 0.0:
                continue
            h = -(uv + (sqrt(disc) if uv >= 0.0 else -sqrt(disc)))
            for which in range(2):
                # Roots of uu p^2 + 2 uv p q + vv q^2 as directions (p, q): no division.
                if which == 0:
                    p, q = h, uu
                else:
                    p, q = vv, h
                for i in range(3):
                    distances[i] = p * u[i] + q * v[i]
                if distances[0] + distances[1] + distances[2] < 0.0:
                    for i in range(3):
                        distances[i] = -distances[i]
                if not (distances[0] > 0.0 and distances[1] > 0.0 and distances[2] > 0.0):
                    continue
                size = distances[1] ** 2 + distances[2] ** 2 - 2.0 * distances[1] * distances[2] * b[2]
                if not size > 0.0:
                    continue
                factor = sqrt(a[2] / size)
                for i in range(3):
                    distances[i] *= factor
                _polish(distances, b, a)
                if not (distances[0] > 0.0 and distances[1] > 0.0 and distances[2] > 0.0):
                    continue
                if count < 4 and _pose_from_distances(rays, points, distances, Rs[count], ts[count]):
                    count += 1
        if count > 0:
            break
    return count


@compiled
def _det(A: FloatArray, B: FloatArray, p: float, q: float) -> float:
    """Determinant of p A + q B, symmetric 3 x 3."""
    m00 = p * A[0, 0] + q * B[0, 0]
    m01 = p * A[0, 1] + q * B[0, 1]
    m02 = p * A[0, 2] + q * B[0, 2]
    m11 = p * A[1, 1] + q * B[1, 1]
    m12 = p * A[1, 2] + q * B[1, 2]
    m22 = p * A[2, 2] + q * B[2, 2]
    value: float = m00 * (m11 * m22 - m12 * m12) - m01 * (m01 * m22 - m12 * m02) + m02 * (m01 * m12 - m11 * m02)
    return value


@compiled
def _plane_basis(normal: FloatArray, u: FloatArray, v: FloatArray) -> None:
    """Two orthonormal vectors across a normal."""
    n = sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    x, y, z = normal[0] / n, normal[1] / n, normal[2] / n
    if abs(x) < 0.6:
        s = sqrt(y * y + z * z)
        u[0], u[1], u[2] = 0.0, z / s, -y / s
    else:
        s = sqrt(x * x + y * y)
        u[0], u[1], u[2] = y / s, -x / s, 0.0
    v[0] = y * u[2] - z * u[1]
    v[1] = z * u[0] - x * u[2]
    v[2] = x * u[1] - y * u[0]


@compiled
def _frame(p: FloatArray, q: FloatArray, out: FloatArray) -> bool:
    """Right-handed orthonormal frame (columns) of two edges."""
    n = sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2)
    c0 = p[1] * q[2] - p[2] * q[1]
    c1 = p[2] * q[0] - p[0] * q[2]
    c2 = p[0] * q[1] - p[1] * q[0]
    m = sqrt(c0 * c0 + c1 * c1 + c2 * c2)
    if n == 0.0 or m <= 1e-12 * n * n:
        return False
    for i in range(3):
        out[i, 0] = p[i] / n
    out[0, 2] = c0 / m
    out[1, 2] = c1 / m
    out[2, 2] = c2 / m
    out[0, 1] = out[1, 2] * out[2, 0] - out[2, 2] * out[1, 0]
    out[1, 1] = out[2, 2] * out[0, 0] - out[0, 2] * out[2, 0]
    out[2, 1] = out[0, 2] * out[1, 0] - out[1, 2] * out[0, 0]
    return True


@compiled
def _pose_from_distances(
    rays: FloatArray, points: FloatArray, distances: FloatArray, R: FloatArray, t: FloatArray
) -> bool:
    """The rigid transform from the points to the rays at their distances, by matching edge frames."""
    F = np.empty((3, 3))
    G = np.empty((3, 3))
    p = np.empty(3)
    q = np.empty(3)
    for i in range(3):
        p[i] = distances[1] * rays[1, i] - distances[0] * rays[0, i]
        q[i] = distances[2] * rays[2, i] - distances[0] * rays[0, i]
    if not _frame(p, q, F):
        return False
    for i in range(3):
        p[i] = points[1, i] - points[0, i]
        q[i] = points[2, i] - points[0, i]
    if not _frame(p, q, G):
        return False
    for i in range(3):
        for j in range(3):
            R[i, j] = F[i, 0] * G[j, 0] + F[i, 1] * G[j, 1] + F[i, 2] * G[j, 2]
    for i in range(3):
        t[i] = distances[0] * rays[0, i] - (R[i, 0] * points[0, 0] + R[i, 1] * points[0, 1] + R[i, 2] * points[0, 2])
    return True
