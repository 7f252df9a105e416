"""P4P with unknown focal lengths: pose, focal length and aspect from four non-coplanar points, compiled.

It plays the role of Fa-P4P: eight measurements for eight unknowns, so every real solution fits exactly and noise is
never averaged. Principal point and distortion are taken from the lens.

Mathematics. With depths ``d_i`` and pixels ``m_i = (u_i, v_i, 1)`` from the principal point, ``d_i m_i = K (R P_i + t)``,
``K = diag(fx, fy, 1)``. Four non-coplanar points are an affine basis, so with the gradients ``c_i`` of their barycentric
coordinates (sum 0) ``sum d_i m_i c_i^T = K R``. Its rows are orthogonal: with ``G_ij = c_i . c_j`` three homogeneous
quadrics ``d^T diag(m^a) G diag(m^b) d = 0``, (a, b) = (u, v), (u, 1), (v, 1), have at most eight common points. On the
plane ``sum d = 4`` they are three quadrics in three unknowns; two of the unknowns are eliminated by writing their
squares and product through the third and demanding that the products agree, which leaves a determinant of degree 8.
Its real roots are isolated between those of its derivatives and polished on the quadrics.

Source: the elimination follows Z. Kukelova, J. Heller, A. Fitzgibbon, Efficient Intersection of Three Quadrics, 2016;
the problem is that of Y. Guo, A Novel Solution to the P4P Problem for an Uncalibrated Camera, 2013.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.geometry.se3 import nearest_rotation
from uvgs_bench.sensor.solution import Solution

# Orthonormal basis of the plane sum d = 0, columns.
_ACROSS = 0.5 * np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
# Positive depths with sum 4 lie within this of (1, 1, 1, 1) along any direction.
_REACH = 3.5
# Two solutions nearer than this are one, found twice.
_SAME = 1e-7
_MOST = 8


@compiled
def _value(p: FloatArray, degree: int, x: float) -> float:
    """Polynomial with ascending coefficients at x."""
    total = p[degree]
    for i in range(degree - 1, -1, -1):
        total = total * x + p[i]
    return total


@compiled
def _bracketed_root(p: FloatArray, degree: int, low: float, high: float) -> float:
    """The root of a polynomial that changes sign once in a bracket: Newton, bisection where it leaves."""
    at_low = _value(p, degree, low)
    x = 0.5 * (low + high)
    for _ in range(60):
        value = p[degree]
        slope = 0.0
        for i in range(degree - 1, -1, -1):
            slope = slope * x + value
            value = value * x + p[i]
        if value == 0.0:
            return x
        if (value < 0.0) == (at_low < 0.0):
            low = x
        else:
            high = x
        new = x - value / slope if slope != 0.0 else low
        if not low < new < high:
            new = 0.5 * (low + high)
        if abs(new - x) <= 1e-15 * (1.0 + abs(x)):
            return new
        x = new
    return x


@compiled
def real_roots(p: FloatArray, low: float, high: float, roots: FloatArray) -> int:
    """Real roots of a polynomial in an interval, ascending, isolated between the roots of its derivatives.

    Args:
        p: Ascending coefficients, shape (degree + 1,).
        low: Start of the interval.
        high: End of the interval.
        roots: Output, shape (degree,).

    Returns:
        Number of roots; touching roots may be missed.
    """
    top = p.shape[0] - 1
    derivative = np.empty(top + 1)
    edges = np.empty(top + 2)
    count = 0
    for degree in range(1, top + 1):
        order = top - degree
        for i in range(degree + 1):
            factor = 1.0
            for k in range(order):
                factor *= (i + order - k) / (order - k)
            derivative[i] = p[i + order] * factor
        edges[0] = low
        for i in range(count):
            edges[i + 1] = roots[i]
        edges[count + 1] = high
        found = 0
        for i in range(count + 1):
            a = _value(derivative, degree, edges[i])
            b = _value(derivative, degree, edges[i + 1])
            if (a < 0.0) != (b < 0.0):
                roots[found] = _bracketed_root(derivative, degree, edges[i], edges[i + 1])
                found += 1
        count = found
    return count


@compiled
def _add_product(out: FloatArray, a: FloatArray, b: FloatArray, factor: float) -> None:
    """out += factor a b for polynomials with ascending coefficients; zeros beyond the degree of ``out``."""
    for i in range(a.shape[0]):
        if a[i] != 0.0:
            for j in range(b.shape[0]):
                if b[j] != 0.0:
                    out[i + j] += factor * a[i] * b[j]


@compiled
def _eliminate(Q: FloatArray, hidden: int, M: FloatArray) -> bool:
    """Write the quadrics as M(x) (y, z, 1) = 0 for the hidden unknown x.

    Args:
        Q: Symmetric matrices of the quadrics in (w0, w1, w2, 1), shape (3, 4, 4).
        hidden: Index of x; y and z are the next ones, cyclically.
        M: Output, polynomials in x, ascending, shape (3, 3, 9).

    Returns:
        False when y^2, yz and z^2 cannot be separated.
    """
    y = (hidden + 1) % 3
    z = (hidden + 2) % 3
    A = np.empty((3, 3))
    rest = np.empty((3, 7))
    for k in range(3):
        A[k, 0] = Q[k, y, y]
        A[k, 1] = 2.0 * Q[k, y, z]
        A[k, 2] = Q[k, z, z]
        # -(a + b x) y, -(a + b x) z, -(a + b x + c x^2)
        rest[k, 0] = -2.0 * Q[k, y, 3]
        rest[k, 1] = -2.0 * Q[k, hidden, y]
        rest[k, 2] = -2.0 * Q[k, z, 3]
        rest[k, 3] = -2.0 * Q[k, hidden, z]
        rest[k, 4] = -Q[k, 3, 3]
        rest[k, 5] = -2.0 * Q[k, hidden, 3]
        rest[k, 6] = -Q[k, hidden, hidden]
    for c in range(3):
        pivot = c
        for r in range(c + 1, 3):
            if abs(A[r, c]) > abs(A[pivot, c]):
                pivot = r
        if abs(A[pivot, c]) < 1e-9:
            return False
        for j in range(3):
            A[c, j], A[pivot, j] = A[pivot, j], A[c, j]
        for j in range(7):
            rest[c, j], rest[pivot, j] = rest[pivot, j], rest[c, j]
        for r in range(3):
            if r != c:
                factor = A[r, c] / A[c, c]
                for j in range(3):
                    A[r, j] -= factor * A[c, j]
                for j in range(7):
                    rest[r, j] -= factor * rest[c, j]
    # Rows: y^2, yz, z^2 = P[., 0] y + P[., 1] z + P[., 2].
    P = np.zeros((3, 3, 3))
    for r in range(3):
        P[r, 0, 0] = rest[r, 0] / A[r, r]
        P[r, 0, 1] = rest[r, 1] / A[r, r]
        P[r, 1, 0] = rest[r, 2] / A[r, r]
        P[r, 1, 1] = rest[r, 3] / A[r, r]
        for j in range(3):
            P[r, 2, j] = rest[r, 4 + j] / A[r, r]
    M[:] = 0.0
    # (y^2) z = (yz) y and (yz) z = (z^2) y: reduce the products once more.
    for row in range(2):
        one, two = P[row], P[row + 1]
        for j in range(3):
            _add_product(M[row, j], one[0], P[1, j], 1.0)
            _add_product(M[row, j], one[1], P[2, j], 1.0)
            _add_product(M[row, j], two[0], P[0, j], -1.0)
            _add_product(M[row, j], two[1], P[1, j], -1.0)
        for i in range(3):
            M[row, 1, i] += one[2, i]
            M[row, 0, i] -= two[2, i]
    # (yz)^2 = (y^2)(z^2).
    squares = np.zeros((3, 9))
    for i in range(2):
        for j in range(2):
            _add_product(squares[i + j], P[1, i], P[1, j], 1.0)
            _add_product(squares[i + j], P[0, i], P[2, j], -1.0)
    for s in range(3):
        for j in range(3):
            _add_product(M[2, j], squares[s, :3], P[s, j], 1.0)
    for i in range(2):
        _add_product(M[2, i], P[1, i], P[1, 2], 2.0)
        _add_product(M[2, i], P[0, i], P[2, 2], -1.0)
        _add_product(M[2, i], P[0, 2], P[2, i], -1.0)
    _add_product(M[2, 2], P[1, 2], P[1, 2], 1.0)
    _add_product(M[2, 2], P[0, 2], P[2, 2], -1.0)
    return True


@compiled
def _determinant(M: FloatArray, out: FloatArray) -> None:
    """Determinant of the polynomial matrix, degree 8."""
    out[:] = 0.0
    minor = np.empty(9)
    for c in range(3):
        a = (c + 1) % 3
        b = (c + 2) % 3
        minor[:] = 0.0
        _add_product(minor, M[0, a, :4], M[1, b, :4], 1.0)
        _add_product(minor, M[0, b, :4], M[1, a, :4], -1.0)
        # Degrees: row 0 and 1 have (2, 2, 3), row 2 has (3, 3, 4); the sum never exceeds 8.
        for i in range(9):
            if minor[i] != 0.0:
                for j in range(9 - i):
                    out[i + j] += minor[i] * M[2, c, j]


@compiled
def _polish(Q: FloatArray, w: FloatArray) -> bool:
    """Newton on the quadrics, in place. Returns whether it arrived."""
    J = np.empty((3, 3))
    r = np.empty(3)
    for _ in range(12):
        for k in range(3):
            total = 0.0
            for i in range(4):
                wi = w[i] if i < 3 else 1.0
                row = Q[k, i, 3]
                for j in range(3):
                    row += Q[k, i, j] * w[j]
                total += wi * row
                if i < 3:
                    J[k, i] = 2.0 * row
            r[k] = total
        c0 = J[1, 1] * J[2, 2] - J[1, 2] * J[2, 1]
        c1 = J[1, 2] * J[2, 0] - J[1, 0] * J[2, 2]
        c2 = J[1, 0] * J[2, 1] - J[1, 1] * J[2, 0]
        det = J[0, 0] * c0 + J[0, 1] * c1 + J[0, 2] * c2
        if det == 0.0:
            return False
        s0 = (r[0] * c0 + J[0, 1] * (J[1, 2] * r[2] - r[1] * J[2, 2]) + J[0, 2] * (r[1] * J[2, 1] - J[1, 1] * r[2])) / det
        s1 = (J[0, 0] * (r[1] * J[2, 2] - J[1, 2] * r[2]) + r[0] * c1 + J[0, 2] * (J[1, 0] * r[2] - r[1] * J[2, 0])) / det
        s2 = (J[0, 0] * (J[1, 1] * r[2] - r[1] * J[2, 1]) + J[0, 1] * (r[1] * J[2, 0] - J[1, 0] * r[2]) + r[0] * c2) / det
        w[0] -= s0
        w[1] -= s1
        w[2] -= s2
        size = abs(s0) + abs(s1) + abs(s2)
        if not size < 10.0:
            return False
        if size < 1e-14:
            return True
    return size < 1e-9


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
    M = np.empty((3, 3, 9))
    polynomial = np.empty(9)
    roots = np.empty(8)
    w = np.empty(3)
    count = 0
    for hidden in range(3):
        if not _eliminate(Q, hidden, M):
            continue
        _determinant(M, polynomial)
        largest = 0.0
        for i in range(9):
            largest = max(largest, abs(polynomial[i]))
        if largest == 0.0:
            continue
        for i in range(9):
            polynomial[i] /= largest
        for r in range(real_roots(polynomial, -_REACH, _REACH, roots)):
            x = roots[r]
            if not _back_substitute(M, x, hidden, w) or not _polish(Q, w):
                continue
            is_new = True
            for i in range(4):
                D[0, i] = 1.0 + _ACROSS[i, 0] * w[0] + _ACROSS[i, 1] * w[1] + _ACROSS[i, 2] * w[2]
                if not D[0, i] > 0.0:
                    is_new = False
            for s in range(count):
                gap = 0.0
                for i in range(4):
                    gap = max(gap, abs(depths[s, i] - D[0, i]))
                if gap < _SAME:
                    is_new = False
            if is_new and count < _MOST:
                for i in range(4):
                    depths[count, i] = D[0, i]
                count += 1
    return count


@compiled
def _back_substitute(M: FloatArray, x: float, hidden: int, w: FloatArray) -> bool:
    """y and z of a root from the null vector of M(x): the longest cross product of two rows."""
    N = np.empty((3, 3))
    for i in range(3):
        norm = 0.0
        for j in range(3):
            N[i, j] = _value(M[i, j], 4, x)
            norm = max(norm, abs(N[i, j]))
        if norm > 0.0:
            for j in range(3):
                N[i, j] /= norm
    best = 0.0
    y = 0.0
    z = 0.0
    for k in range(3):
        a = N[(k + 1) % 3]
        b = N[(k + 2) % 3]
        n0 = a[1] * b[2] - a[2] * b[1]
        n1 = a[2] * b[0] - a[0] * b[2]
        n2 = a[0] * b[1] - a[1] * b[0]
        size = n0 * n0 + n1 * n1 + n2 * n2
        if size > best and n2 != 0.0:
            best = size
            y = n0 / n2
            z = n1 / n2
    w[hidden] = x
    w[(hidden + 1) % 3] = y
    w[(hidden + 2) % 3] = z
    return best > 0.0 and abs(y) < 1e3 and abs(z) < 1e3


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
    depths = np.empty((_MOST, 4))
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
    Rs, ts, focal = np.empty((_MOST, 3, 3)), np.empty((_MOST, 3)), np.empty((_MOST, 2))
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
