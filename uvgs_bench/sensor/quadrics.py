"""Common points of three quadrics in three unknowns, compiled.

Two of the unknowns are eliminated by writing their squares and product through the third and demanding that the
products agree, which leaves a determinant of degree 8. Its real roots are isolated between those of its derivatives
and polished on the quadrics. Each unknown takes its turn as the third, so one unlucky direction loses nothing.

Source: Z. Kukelova, J. Heller, A. Fitzgibbon, Efficient Intersection of Three Quadrics and Applications in Computer
Vision, CVPR 2016 (the idea of the elimination).
"""

from __future__ import annotations

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled

MOST_POINTS = 8
# Two points nearer than this are one, found twice.
_SAME = 1e-7


@compiled
def _value(p: FloatArray, degree: int, x: float) -> float:
    """Polynomial with ascending coefficients at x."""
    total = float(p[degree])
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
    """Add ``factor a b`` to ``out`` for polynomials with ascending coefficients; zeros beyond the degree of ``out``."""
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
        s0 = (
            r[0] * c0 + J[0, 1] * (J[1, 2] * r[2] - r[1] * J[2, 2]) + J[0, 2] * (r[1] * J[2, 1] - J[1, 1] * r[2])
        ) / det
        s1 = (
            J[0, 0] * (r[1] * J[2, 2] - J[1, 2] * r[2]) + r[0] * c1 + J[0, 2] * (J[1, 0] * r[2] - r[1] * J[2, 0])
        ) / det
        s2 = (
            J[0, 0] * (J[1, 1] * r[2] - r[1] * J[2, 1]) + J[0, 1] * (r[1] * J[2, 0] - J[1, 0] * r[2]) + r[0] * c2
        ) / det
        w[0] -= s0
        w[1] -= s1
        w[2] -= s2
        size = abs(s0) + abs(s1) + abs(s2)
        if not size < 10.0:
            return False
        if size < 1e-14:
            return True
    return bool(size < 1e-9)


@compiled
def _back_substitute(M: FloatArray, x: float, hidden: int, w: FloatArray) -> bool:
    """The other two unknowns of a root from the null vector of M(x): the longest cross product of two rows."""
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
def intersect_quadrics(Q: FloatArray, reach: float, points: FloatArray) -> int:
    """Common points of three quadrics ``(w, 1)^T Q (w, 1) = 0``.

    Args:
        Q: Symmetric matrices, shape (3, 4, 4), coefficients of order 1.
        reach: Points whose coordinates stay below this are found.
        points: Output, shape (8, 3).

    Returns:
        Number of points; where two of them touch, both may be missed.
    """
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
        for r in range(real_roots(polynomial, -reach, reach, roots)):
            if not _back_substitute(M, roots[r], hidden, w) or not _polish(Q, w):
                continue
            is_new = True
            for s in range(count):
                gap = max(abs(points[s, 0] - w[0]), max(abs(points[s, 1] - w[1]), abs(points[s, 2] - w[2])))
                if gap < _SAME:
                    is_new = False
            if is_new and count < MOST_POINTS:
                for i in range(3):
                    points[count, i] = w[i]
                count += 1
    return count
