"""Compiled: how likely one of four named lights is no LED, against all being what they are called.

Four lights leave two redundant numbers. Every other pose that three of them allow, with the fourth a stray anywhere,
explains the picture too. How likely all these are together, over the named four, is the most that can be known of one
picture: the ratio Neyman and Pearson ask for.
"""

from __future__ import annotations

from math import exp, inf, isnan, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.evidence_kernels import LEAST_COSINE, MOST_APPEARANCE_COST, appearance_cost
from uvgs_bench.sensor.pose_kernels import normal_equations
from uvgs_bench.sensor.search_four import carried_by, combine, cross, dot, ray_slopes, shines
from uvgs_bench.sensor.three_rays import solve_distances

# Lights nobody placed differ in brightness by this factor.
STRAY_FACTOR = 30.0
_MOST_COST = 60.0


# A pose nearer than this to that of the named four is the same answer: turn of its edges, rad, and shift per range.
_SAME_TURN_RAD = 0.1
_SAME_SHIFT = 0.05
# Rows of what a triangle carries: the axes of its corners.
_AXES = 2


@compiled
def _root_of_determinant(H: FloatArray) -> float:
    """Square root of the determinant of a positive definite matrix of six, which is spoilt; else 0."""
    product = 1.0
    for i in range(6):
        for j in range(i):
            for k in range(j):
                H[i, j] -= H[i, k] * H[j, k]
            H[i, j] /= H[j, j]
            H[i, i] -= H[i, j] * H[i, j]
        if not H[i, i] > 0.0:
            return 0.0
        H[i, i] = sqrt(H[i, i])
        product *= H[i, i]
    return product


@compiled
def _shape_factor(p: tuple[float, float, float], q: tuple[float, float, float]) -> float:
    """What of the density of poses that put a triangle on three rays depends on its two edges alone.

    The 6 x 6 Jacobian of the rays by the pose is this times the 3 x 3 one of the squared edges by the distances, over
    the squared distances: both complete the nine motions of three points, one by turns and shifts, one by edges.
    """
    r = (q[0] - p[0], q[1] - p[1], q[2] - p[2])
    n = cross(p, q)
    pp, qq, rr = dot(p, p), dot(q, q), dot(r, r)
    pq, pr, qr = dot(p, q), dot(p, r), dot(q, r)
    rigid = 27.0 * dot(n, n) / 3.0 * (pp + qq + rr) / 3.0
    edges = 8.0 * pp * qq * rr - 2.0 * pp * qr * qr - 2.0 * qq * pr * pr - 2.0 * rr * pq * pq - 2.0 * pq * pr * qr
    return sqrt(rigid / edges)


@compiled
def _is_near(v: tuple[float, float, float], a: FloatArray, share: float, b: FloatArray, most: float) -> bool:
    """Whether v is a - share b but for a part of its length."""
    off = 0.0
    whole = 0.0
    for j in range(3):
        w = a[j] - share * b[j]
        off += (v[j] - w) ** 2
        whole += w * w
    return off < most * most * whole


@compiled
def stray_odds(
    model_id: int,
    lens: FloatArray,
    rays: FloatArray,
    px: FloatArray,
    sigma: FloatArray,
    looks: FloatArray,
    look_sigma: FloatArray,
    exponent: float,
    leds: FloatArray,
    axes: FloatArray,
    cos_loose: FloatArray,
    orders: NDArray[np.int64],
    R: FloatArray,
    t: FloatArray,
    cost: float,
    min_range_m: float,
    max_range_m: float,
    field_px2: float,
) -> float:
    """Likelihood of all other poses of three of four lights, the fourth a stray, over that of the named four.

    Poses are drawn evenly in attitude, direction and range; a stray evenly over the field and of any brightness.

    Args:
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        rays: Unit rays of the lights, in the order of the LEDs they are called, shape (4, 3).
        px: Their centroids, shape (4, 2), raw px.
        sigma: Their deviations, shape (4,), px.
        looks: Logarithms of their light and width, shape (4, 2), NaN where unknown.
        look_sigma: Deviations of these, shape (2,); 0 leaves one out.
        exponent: Exponent of the emission.
        leds: LED positions, shape (4, 3), m.
        axes: Emission axes, shape (4, 3).
        cos_loose: Cosine of the widest visible angle with room beyond it, shape (4,).
        orders: Ordered triples of LEDs, all 24, shape (24, 3).
        R: The rotation of the named four, shape (3, 3).
        t: Its translation, shape (3,), m.
        cost: Its chi-square and what its cones cost.
        min_range_m: Nearest beacon, m.
        max_range_m: Farthest beacon, m.
        field_px2: Area in which strays lie, px^2.

    Returns:
        The ratio.

    Source: the integral of a Gaussian likelihood about its maximum, (2 pi)^3 / sqrt(det H), for each explanation.
    """
    H = np.empty((6, 6))
    named = np.arange(4)
    normal_equations(model_id, lens, leds, px, sigma, R, t, t, H, np.empty(6), np.empty((4, 2)))
    root = _root_of_determinant(H)
    square = t[0] * t[0] + t[1] * t[1] + t[2] * t[2]
    if not root > 0.0:
        return inf
    four = exp(-0.5 * min(cost, _MOST_COST)) / (root * square)
    widths = np.array([0.0, look_sigma[1]])
    lights = np.array([look_sigma[0], 0.0])
    four_light = appearance_cost(R, t, leds, axes, named, looks, lights, exponent)
    four_width = appearance_cost(R, t, leds, axes, named, looks, widths, exponent)
    has_light = look_sigma[0] > 0.0
    has_width = look_sigma[1] > 0.0
    for i in range(4):
        has_light = has_light and not isnan(looks[i, 0])
        has_width = has_width and not isnan(looks[i, 1])
    slopes = np.empty((4, 2, 3))
    ray_slopes(model_id, lens, rays, slopes)
    areas = np.empty(4)
    for i in range(4):
        u = (slopes[i, 0, 0], slopes[i, 0, 1], slopes[i, 0, 2])
        v = (slopes[i, 1, 0], slopes[i, 1, 1], slopes[i, 1, 2])
        n = cross(u, v)
        areas[i] = sqrt(dot(n, n)) * sigma[i] * sigma[i]
    corners = np.empty((4, 3))
    for i in range(4):
        for j in range(3):
            corners[i, j] = R[j, 0] * leds[i, 0] + R[j, 1] * leds[i, 1] + R[j, 2] * leds[i, 2] + t[j]
    carried = np.empty((6, 3))
    distances = np.empty((4, 3))
    values = np.empty(3)
    odds = 0.0
    for k in range(orders.shape[0]):
        l0, l1, l2 = orders[k, 0], orders[k, 1], orders[k, 2]
        carried_by(leds, axes, orders[k], carried)
        p = (leds[l1, 0] - leds[l0, 0], leds[l1, 1] - leds[l0, 1], leds[l1, 2] - leds[l0, 2])
        q = (leds[l2, 0] - leds[l0, 0], leds[l2, 1] - leds[l0, 1], leds[l2, 2] - leds[l0, 2])
        r = (q[0] - p[0], q[1] - p[1], q[2] - p[2])
        pp, qq, rr = dot(p, p), dot(q, q), dot(r, r)
        factor = _shape_factor(p, q)
        for stray in range(4):
            i0 = 1 if stray == 0 else 0
            i1 = 2 if stray <= 1 else 1
            i2 = 3 if stray <= 2 else 2
            others = (i0, i1, i2)
            gain = 1.0
            if has_width:
                mean = (looks[i0, 1] + looks[i1, 1] + looks[i2, 1]) / 3.0
                spread = (looks[i0, 1] - mean) ** 2 + (looks[i1, 1] - mean) ** 2 + (looks[i2, 1] - mean) ** 2
                gain = exp(0.5 * (four_width - min(spread / look_sigma[1] ** 2, MOST_APPEARANCE_COST)))
            r0 = (rays[i0, 0], rays[i0, 1], rays[i0, 2])
            r1 = (rays[i1, 0], rays[i1, 1], rays[i1, 2])
            r2 = (rays[i2, 0], rays[i2, 1], rays[i2, 2])
            found = solve_distances(dot(r0, r1), dot(r0, r2), dot(r1, r2), pp, qq, rr, distances)
            for at in range(found):
                d0, d1, d2 = distances[at, 0], distances[at, 1], distances[at, 2]
                p0 = (d0 * r0[0], d0 * r0[1], d0 * r0[2])
                p1 = (d1 * r1[0], d1 * r1[1], d1 * r1[2])
                p2 = (d2 * r2[0], d2 * r2[1], d2 * r2[2])
                square = (d0 * d0 + d1 * d1 + d2 * d2) / 3.0
                if square < min_range_m * min_range_m or square > max_range_m * max_range_m:
                    continue
                e1 = (p1[0] - p0[0], p1[1] - p0[1], p1[2] - p0[2])
                e2 = (p2[0] - p0[0], p2[1] - p0[1], p2[2] - p0[2])
                e3 = (p2[0] - p1[0], p2[1] - p1[1], p2[2] - p1[2])
                n = cross(e1, e2)
                a0, a1 = combine(carried[_AXES], e1, e2, n), combine(carried[_AXES + 1], e1, e2, n)
                a2 = combine(carried[_AXES + 2], e1, e2, n)
                if not (shines(p0, a0, cos_loose[l0]) and shines(p1, a1, cos_loose[l1])):
                    continue
                if not shines(p2, a2, cos_loose[l2]):
                    continue
                # The named four are not their own rival.
                if (
                    l0 == i0
                    and l1 == i1
                    and l2 == i2
                    and (
                        _is_near(p0, corners[i0], 0.0, corners[i0], _SAME_SHIFT)
                        and _is_near(e1, corners[i1], 1.0, corners[i0], _SAME_TURN_RAD)
                        and _is_near(e2, corners[i2], 1.0, corners[i0], _SAME_TURN_RAD)
                    )
                ):
                    continue
                det = dot(e1, r0) * dot(e3, r1) * dot(e2, r2) - dot(e2, r0) * dot(e1, r1) * dot(e3, r2)
                weight = d0 * d0 * d1 * d1 * d2 * d2 / (factor * max(abs(det), 1e-12 * sqrt(pp * qq * rr)) * square)
                if has_light:
                    mean = 0.0
                    for c in range(3):
                        d = (d0, d1, d2)[c]
                        corner = (p0, p1, p2)[c]
                        axis = (a0, a1, a2)[c]
                        values[c] = looks[others[c], 0] + 2.0 * log(d)
                        if axis[0] != 0.0 or axis[1] != 0.0 or axis[2] != 0.0:
                            values[c] -= exponent * log(max(-dot(corner, axis) / d, LEAST_COSINE))
                        mean += values[c] / 3.0
                    spread = (values[0] - mean) ** 2 + (values[1] - mean) ** 2 + (values[2] - mean) ** 2
                    weight *= exp(0.5 * (four_light - min(spread / look_sigma[0] ** 2, MOST_APPEARANCE_COST)))
                odds += gain * weight * areas[i0] * areas[i1] * areas[i2] * sigma[stray] * sigma[stray]
    if has_light:
        # One light against the mean of three others. Strays may well be as wide as LEDs, so width has no such gain.
        odds *= sqrt(2.0 * pi * 4.0 / 3.0) * look_sigma[0] / log(STRAY_FACTOR)
    return float(odds * 2.0 * pi / field_px2 / four)
