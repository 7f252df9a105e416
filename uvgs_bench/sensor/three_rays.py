"""Three rays and a triangle: how far along the rays its corners lie, compiled; scalars only, for tight loops.

Source: M. Persson, K. Nordberg, Lambda Twist: An Accurate Fast Robust Perspective Three Point (P3P) Solver, ECCV 2018.
Written from the equations of the paper; the degenerate conic is split into its two planes by its adjugate
(J. Richter-Gebert, Perspectives on Projective Geometry, section 11.1), so that no distance is singled out to divide by.
"""

from __future__ import annotations

from math import acos, cos, pi, sqrt

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled

# Rays of a larger cosine, some 5e-7 rad apart, are one ray: three of them put a triangle at any distance beyond.
_COINCIDENT = 1.0 - 1e-13

Plane = tuple[float, float, float]


@compiled
def _cubic_root(b: float, c: float, d: float, which: int) -> tuple[float, bool]:
    """Real root number ``which`` of x^3 + b x^2 + c x + d, polished by Newton, and whether there is one."""
    q = (b * b - 3.0 * c) / 9.0
    r = (b * (2.0 * b * b - 9.0 * c) + 27.0 * d) / 54.0
    q3 = q * q * q
    if r * r < q3:
        angle = acos(min(1.0, max(-1.0, r / sqrt(q3))))
        x = -2.0 * sqrt(q) * cos((angle + 2.0 * pi * (which - 1)) / 3.0) - b / 3.0
    elif which > 0:
        return 0.0, False
    else:
        e = (abs(r) + sqrt(max(r * r - q3, 0.0))) ** (1.0 / 3.0)
        if r > 0.0:
            e = -e
        x = e + (q / e if e != 0.0 else 0.0) - b / 3.0
    for _ in range(4):
        slope = c + x * (2.0 * b + 3.0 * x)
        if slope == 0.0:
            break
        step = (d + x * (c + x * (b + x))) / slope
        x -= step
        if abs(step) < 1e-15 * abs(x):
            break
    return x, True


@compiled
def _determinant(p: float, q: float, b0: float, b1: float, b2: float, a12: float, a13: float) -> float:
    """Determinant of p D1 + q D2."""
    k = p * a12 + q * a13
    m00 = p + q
    m01 = -p * b0
    m02 = -q * b1
    m11 = p - k
    m12 = k * b2
    m22 = q - k
    value: float = m00 * (m11 * m22 - m12 * m12) - m01 * (m01 * m22 - m12 * m02) + m02 * (m01 * m12 - m11 * m02)
    return value


@compiled
def _planes(m00: float, m01: float, m02: float, m11: float, m12: float, m22: float) -> tuple[Plane, Plane, bool]:
    """The two planes of a degenerate conic, and whether they are real."""
    none = (0.0, 0.0, 0.0)
    # Minus the adjugate is the square of the line both planes share.
    b00 = m12 * m12 - m11 * m22
    b11 = m02 * m02 - m00 * m22
    b22 = m01 * m01 - m00 * m11
    b01 = m01 * m22 - m02 * m12
    b02 = m02 * m11 - m01 * m12
    b12 = m00 * m12 - m01 * m02
    if b00 + b11 + b22 <= 0.0:
        return none, none, False
    if b00 >= b11 and b00 >= b22:
        root = sqrt(b00)
        x, y, z = root, b01 / root, b02 / root
    elif b11 >= b22:
        root = sqrt(b11)
        x, y, z = b01 / root, root, b12 / root
    else:
        root = sqrt(b22)
        x, y, z = b02 / root, b12 / root, root
    # D0 plus the skew matrix of that line is the outer product of the planes: any row and column through its largest.
    c01, c10 = m01 - z, m01 + z
    c02, c20 = m02 + y, m02 - y
    c12, c21 = m12 - x, m12 + x
    row0 = max(abs(m00), abs(c01), abs(c02))
    row1 = max(abs(c10), abs(m11), abs(c12))
    row2 = max(abs(c20), abs(c21), abs(m22))
    if row0 >= row1 and row0 >= row2:
        first = (m00, c01, c02)
    elif row1 >= row2:
        first = (c10, m11, c12)
    else:
        first = (c20, c21, m22)
    size0, size1, size2 = abs(first[0]), abs(first[1]), abs(first[2])
    if size0 >= size1 and size0 >= size2:
        return first, (m00, c10, c20), True
    if size1 >= size2:
        return first, (c01, m11, c21), True
    return first, (c02, c12, m22), True


@compiled
def solve_distances(b0: float, b1: float, b2: float, a0: float, a1: float, a2: float, distances: FloatArray) -> int:
    """Distances along three rays that put three points at their mutual distances.

    Args:
        b0: Cosine between rays 0 and 1.
        b1: Between rays 0 and 2.
        b2: Between rays 1 and 2.
        a0: Squared distance between points 0 and 1, m^2.
        a1: Between points 0 and 2, m^2.
        a2: Between points 1 and 2, m^2.
        distances: Output, shape (4, 3), m.

    Returns:
        Number of solutions, 0 to 4; all distances are positive.
    """
    if not max(b0, b1, b2) < _COINCIDENT:
        return 0
    # D1 = M12 a23 - M23 a12, D2 = M13 a23 - M23 a13: both vanish on the distances.
    a12 = a0 / a2
    a13 = a1 / a2
    d1 = _determinant(1.0, 0.0, b0, b1, b2, a12, a13)
    d2 = _determinant(0.0, 1.0, b0, b1, b2, a12, a13)
    plus = _determinant(1.0, 1.0, b0, b1, b2, a12, a13)
    minus = _determinant(1.0, -1.0, b0, b1, b2, a12, a13)
    if d2 == 0.0:
        return 0
    c2 = (0.5 * (plus + minus) - d1) / d2
    c1 = (0.5 * (plus - minus) - d2) / d2
    enough = 1e-15 * (a0 + a1 + a2)
    count = 0
    for which in range(3):
        x, exists = _cubic_root(c2, c1, d1 / d2, which)
        if not exists:
            break
        k = a12 + x * a13
        first, second, is_real = _planes(1.0 + x, -b0, -x * b1, 1.0 - k, k * b2, x - k)
        if not is_real:
            continue
        for side in range(2):
            n0, n1, n2 = first if side == 0 else second
            size = sqrt(n0 * n0 + n1 * n1 + n2 * n2)
            if size == 0.0:
                continue
            n0, n1, n2 = n0 / size, n1 / size, n2 / size
            # Two vectors of equal length across the normal.
            if abs(n0) < 0.6:
                u0, u1, u2 = 0.0, n2, -n1
            else:
                u0, u1, u2 = n1, -n0, 0.0
            v0 = n1 * u2 - n2 * u1
            v1 = n2 * u0 - n0 * u2
            v2 = n0 * u1 - n1 * u0
            # On this plane D1 = -x D2: take the larger of the two forms.
            if abs(x) < 1.0:
                m00, m01, m02, m11, m12, m22 = 1.0, 0.0, -b1, -a13, a13 * b2, 1.0 - a13
            else:
                m00, m01, m02, m11, m12, m22 = 1.0, -b0, 0.0, 1.0 - a12, a12 * b2, -a12
            x0 = m00 * u0 + m01 * u1 + m02 * u2
            x1 = m01 * u0 + m11 * u1 + m12 * u2
            x2 = m02 * u0 + m12 * u1 + m22 * u2
            y0 = m00 * v0 + m01 * v1 + m02 * v2
            y1 = m01 * v0 + m11 * v1 + m12 * v2
            y2 = m02 * v0 + m12 * v1 + m22 * v2
            uu = x0 * u0 + x1 * u1 + x2 * u2
            uv = x0 * v0 + x1 * v1 + x2 * v2
            vv = y0 * v0 + y1 * v1 + y2 * v2
            disc = uv * uv - uu * vv
            if disc < 0.0:
                continue
            h = -(uv + (sqrt(disc) if uv >= 0.0 else -sqrt(disc)))
            for pick in range(2):
                # Roots of uu p^2 + 2 uv p q + vv q^2 as directions (p, q): no division.
                p, q = (h, uu) if pick == 0 else (vv, h)
                s0, s1, s2 = p * u0 + q * v0, p * u1 + q * v1, p * u2 + q * v2
                if s0 + s1 + s2 < 0.0:
                    s0, s1, s2 = -s0, -s1, -s2
                if not (s0 > 0.0 and s1 > 0.0 and s2 > 0.0):
                    continue
                square = s1 * s1 + s2 * s2 - 2.0 * s1 * s2 * b2
                if not square > 0.0:
                    continue
                factor = sqrt(a2 / square)
                s0, s1, s2 = s0 * factor, s1 * factor, s2 * factor
                # Newton on the cosine laws.
                for _ in range(3):
                    r0 = s0 * s0 + s1 * s1 - 2.0 * s0 * s1 * b0 - a0
                    r1 = s0 * s0 + s2 * s2 - 2.0 * s0 * s2 * b1 - a1
                    r2 = s1 * s1 + s2 * s2 - 2.0 * s1 * s2 * b2 - a2
                    if abs(r0) + abs(r1) + abs(r2) < enough:
                        break
                    p00 = 2.0 * (s0 - s1 * b0)
                    p01 = 2.0 * (s1 - s0 * b0)
                    p10 = 2.0 * (s0 - s2 * b1)
                    p12 = 2.0 * (s2 - s0 * b1)
                    p21 = 2.0 * (s1 - s2 * b2)
                    p22 = 2.0 * (s2 - s1 * b2)
                    det = -p00 * p12 * p21 - p01 * p10 * p22
                    if det == 0.0:
                        break
                    per = 1.0 / det
                    s0 -= (-p12 * p21 * r0 - p01 * p22 * r1 + p01 * p12 * r2) * per
                    s1 -= (-p10 * p22 * r0 + p00 * p22 * r1 - p00 * p12 * r2) * per
                    s2 -= (p10 * p21 * r0 - p00 * p21 * r1 - p01 * p10 * r2) * per
                if s0 > 0.0 and s1 > 0.0 and s2 > 0.0 and count < 4:
                    distances[count, 0] = s0
                    distances[count, 1] = s1
                    distances[count, 2] = s2
                    count += 1
        if count > 0:
            break
    return count


@compiled
def pose_from_distances(
    rays: FloatArray, points: FloatArray, d0: float, d1: float, d2: float, R: FloatArray, t: FloatArray
) -> bool:
    """The rigid transform from three points to three rays at their distances, by matching the frames of two edges.

    Args:
        rays: Unit rays in the camera frame, shape (3, 3), one a row.
        points: Points in the beacon frame, shape (3, 3), m, one a row.
        d0: Distance along ray 0, m.
        d1: Along ray 1, m.
        d2: Along ray 2, m.
        R: Output, rotation camera_from_beacon, shape (3, 3).
        t: Output, translation, shape (3,), m.

    Returns:
        False when the points lie on a line.
    """
    f, is_frame = _frame(
        d1 * rays[1, 0] - d0 * rays[0, 0], d1 * rays[1, 1] - d0 * rays[0, 1], d1 * rays[1, 2] - d0 * rays[0, 2],
        d2 * rays[2, 0] - d0 * rays[0, 0], d2 * rays[2, 1] - d0 * rays[0, 1], d2 * rays[2, 2] - d0 * rays[0, 2],
    )  # fmt: skip
    g, is_other = _frame(
        points[1, 0] - points[0, 0], points[1, 1] - points[0, 1], points[1, 2] - points[0, 2],
        points[2, 0] - points[0, 0], points[2, 1] - points[0, 1], points[2, 2] - points[0, 2],
    )  # fmt: skip
    if not (is_frame and is_other):
        return False
    for i in range(3):
        R[i, 0] = f[i] * g[0] + f[3 + i] * g[3] + f[6 + i] * g[6]
        R[i, 1] = f[i] * g[1] + f[3 + i] * g[4] + f[6 + i] * g[7]
        R[i, 2] = f[i] * g[2] + f[3 + i] * g[5] + f[6 + i] * g[8]
        t[i] = d0 * rays[0, i] - (R[i, 0] * points[0, 0] + R[i, 1] * points[0, 1] + R[i, 2] * points[0, 2])
    return True


@compiled
def _frame(
    px: float, py: float, pz: float, qx: float, qy: float, qz: float
) -> tuple[tuple[float, float, float, float, float, float, float, float, float], bool]:
    """Right-handed orthonormal axes, one after the other, of two edges: along the first, across it, normal to both."""
    n = sqrt(px * px + py * py + pz * pz)
    cx = py * qz - pz * qy
    cy = pz * qx - px * qz
    cz = px * qy - py * qx
    m = sqrt(cx * cx + cy * cy + cz * cz)
    if n == 0.0 or m <= 1e-12 * n * n:
        return (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), False
    ax, ay, az = px / n, py / n, pz / n
    bx, by, bz = cx / m, cy / m, cz / m
    return (ax, ay, az, by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax, bx, by, bz), True
