"""Compiled search over labelings of four LEDs: three rays fix a pose, the fourth LED is predicted with its doubt.

The corners of a triangle in the camera frame carry everything rigid with them, so that where the fourth LED lies, where
the LEDs shine, and how sure both are, follow from the three distances without a rotation. Only what survives becomes a
pose.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens_kernels import project_point_with_jacobian
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.evidence_kernels import appearance_cost, cone_cost
from uvgs_bench.sensor.solvers.uvgs_lm import refine_pose
from uvgs_bench.sensor.three_rays import pose_from_distances, solve_distances

KEPT = 64
# Predicted to first order; beyond this no refinement brings a labeling back.
HOPELESS_COST = 2500.0
_REFINE_STEPS = 15
# First order overstates a cost by less than this factor where it matters; what starts above is no rival.
_WORTH_REFINING = 40.0
_WORTH_REFINING_FLOOR = 625.0
# Relative size below which three distances are not determined by their rays.
_SINGULAR = 1e-7
# Rows of a carried frame: the LED left, the beacon's origin, then the axes of the four LEDs.
_FOURTH, _ORIGIN, _AXES = 0, 1, 2

Vector = tuple[float, float, float]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    """Cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def dot(a: Vector, b: Vector) -> float:
    """Dot product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def ray_slopes(model_id: int, lens: FloatArray, rays: FloatArray, out: FloatArray) -> None:
    """How each unit ray turns with its pixel, shape (m, 2, 3): the pseudo-inverse of the projection at the ray."""
    for i in range(rays.shape[0]):
        _, _, _, ux, uy, uz, vx, vy, vz = project_point_with_jacobian(
            model_id, lens, rays[i, 0], rays[i, 1], rays[i, 2]
        )
        uu = ux * ux + uy * uy + uz * uz
        uv = ux * vx + uy * vy + uz * vz
        vv = vx * vx + vy * vy + vz * vz
        per = 1.0 / (uu * vv - uv * uv)
        out[i, 0] = (vv * ux - uv * vx) * per, (vv * uy - uv * vy) * per, (vv * uz - uv * vz) * per
        out[i, 1] = (uu * vx - uv * ux) * per, (uu * vy - uv * uy) * per, (uu * vz - uv * uz) * per


@compiled
def carried_by(leds: FloatArray, axes: FloatArray, triple: NDArray[np.int64], out: FloatArray) -> None:
    """What a triangle carries, in its two edges from the first corner and their cross product, shape (6, 3)."""
    a, b, c = triple[0], triple[1], triple[2]
    left = 6 - a - b - c
    p = (leds[b, 0] - leds[a, 0], leds[b, 1] - leds[a, 1], leds[b, 2] - leds[a, 2])
    q = (leds[c, 0] - leds[a, 0], leds[c, 1] - leds[a, 1], leds[c, 2] - leds[a, 2])
    n = cross(p, q)
    square = dot(n, n)
    first = cross(q, n)
    second = cross(n, p)
    for row in range(6):
        if row == _FOURTH:
            w = (leds[left, 0] - leds[a, 0], leds[left, 1] - leds[a, 1], leds[left, 2] - leds[a, 2])
        elif row == _ORIGIN:
            w = (-leds[a, 0], -leds[a, 1], -leds[a, 2])
        else:
            led = left if row == _AXES + 3 else triple[row - _AXES]
            w = (axes[led, 0], axes[led, 1], axes[led, 2])
        out[row, 0] = dot(w, first) / square
        out[row, 1] = dot(w, second) / square
        out[row, 2] = dot(w, n) / square


@compiled
def combine(k: FloatArray, e1: Vector, e2: Vector, n: Vector) -> Vector:
    """What a triangle carries, from its two edges in the camera frame and their cross product."""
    return (
        k[0] * e1[0] + k[1] * e2[0] + k[2] * n[0],
        k[0] * e1[1] + k[1] * e2[1] + k[2] * n[1],
        k[0] * e1[2] + k[1] * e2[2] + k[2] * n[2],
    )


@compiled
def shines(p: Vector, axis: Vector, cos_limit: float) -> bool:
    """Whether the camera lies within a cone about an LED's axis."""
    return cos_limit <= -1.0 or -dot(p, axis) >= cos_limit * sqrt(dot(p, p))


@compiled
def _by_rays(
    w: Vector, k: FloatArray, p0: Vector, p1: Vector, p2: Vector, r0: Vector, r1: Vector, r2: Vector
) -> tuple[Vector, Vector, Vector, bool]:
    """How ``w`` times the fourth LED moves with each of three rays, and whether their distances are determined.

    The edges keep their lengths while the rays turn, which fixes how the distances change; its transpose is solved.
    """
    none = (0.0, 0.0, 0.0)
    e01 = (p0[0] - p1[0], p0[1] - p1[1], p0[2] - p1[2])
    e02 = (p0[0] - p2[0], p0[1] - p2[1], p0[2] - p2[2])
    e12 = (p1[0] - p2[0], p1[1] - p2[1], p1[2] - p2[2])
    # The cross product of the edges moves by their turn.
    x = cross(w, e02)
    y = cross(e01, w)
    g1 = (k[0] * w[0] + k[2] * x[0], k[0] * w[1] + k[2] * x[1], k[0] * w[2] + k[2] * x[2])
    g2 = (k[1] * w[0] + k[2] * y[0], k[1] * w[1] + k[2] * y[1], k[1] * w[2] + k[2] * y[2])
    g0 = (w[0] - g1[0] - g2[0], w[1] - g1[1] - g2[1], w[2] - g1[2] - g2[2])
    a01, b01 = dot(e01, r0), dot(e01, r1)
    a02, b02 = dot(e02, r0), dot(e02, r2)
    a12, b12 = dot(e12, r1), dot(e12, r2)
    det = a01 * a12 * b02 - a02 * b01 * b12
    scale = sqrt(dot(e01, e01) * dot(e02, e02) * dot(e12, e12))
    if not abs(det) > _SINGULAR * scale:
        return none, none, none, False
    h0, h1, h2 = dot(g0, r0), dot(g1, r1), dot(g2, r2)
    per = 1.0 / det
    mixed = h1 * b12 + h2 * a12
    x01 = (h0 * a12 * b02 + a02 * mixed) * per
    x02 = -(a01 * mixed + h0 * b01 * b12) * per
    x12 = (a01 * h1 * b02 + a02 * h2 * b01 + h0 * b01 * b02) * per
    d0, d1, d2 = sqrt(dot(p0, p0)), sqrt(dot(p1, p1)), sqrt(dot(p2, p2))
    s0 = (
        d0 * (g0[0] - x01 * e01[0] - x02 * e02[0]),
        d0 * (g0[1] - x01 * e01[1] - x02 * e02[1]),
        d0 * (g0[2] - x01 * e01[2] - x02 * e02[2]),
    )
    s1 = (
        d1 * (g1[0] + x01 * e01[0] - x12 * e12[0]),
        d1 * (g1[1] + x01 * e01[1] - x12 * e12[1]),
        d1 * (g1[2] + x01 * e01[2] - x12 * e12[2]),
    )
    s2 = (
        d2 * (g2[0] + x02 * e02[0] + x12 * e12[0]),
        d2 * (g2[1] + x02 * e02[1] + x12 * e12[1]),
        d2 * (g2[2] + x02 * e02[2] + x12 * e12[2]),
    )
    return s0, s1, s2, True


@compiled
def _spread(s: Vector, slope: FloatArray, sigma: float) -> tuple[float, float]:
    """What a ray's doubt adds: its gradient in pixels, times the deviation."""
    return (
        sigma * (s[0] * slope[0, 0] + s[1] * slope[0, 1] + s[2] * slope[0, 2]),
        sigma * (s[0] * slope[1, 0] + s[1] * slope[1, 1] + s[2] * slope[1, 2]),
    )


@compiled
def search_four(
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
    cos_limit: FloatArray,
    cos_loose: FloatArray,
    led_triples: NDArray[np.int64],
    reach_px: float,
    min_range_m: float,
    max_range_m: float,
    costs: FloatArray,
    chi2s: FloatArray,
    cones: FloatArray,
    Rs: FloatArray,
    ts: FloatArray,
    assignments: NDArray[np.int64],
) -> tuple[int, int, float]:
    """Score labelings: every triple of blobs against every order of one triple of LEDs.

    The fourth is predicted with its uncertainty from the triple, and each blob near it is a labeling; its innovation is
    to first order the cost of the refined fit, so only what can matter is refined, the most promising first.

    Args:
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        rays: Unit rays of the blobs, shape (m, 3).
        px: Centroids, shape (m, 2), raw px.
        sigma: Their deviations including model error, shape (m,), px.
        looks: Logarithms of light and width of the blobs, shape (m, 2), NaN where unknown.
        look_sigma: Their deviations, shape (2,); 0 leaves one out.
        exponent: Exponent of the emission.
        leds: LED positions, shape (4, 3), m.
        axes: Emission axes, shape (4, 3).
        cos_limit: Cosine of the widest visible angle, shape (4,); -2 for an LED that shines everywhere.
        cos_loose: The same with room beyond it.
        led_triples: Orders of the LED triple to start from, shape (k, 3).
        reach_px: Two blobs of one beacon are at most this far apart, px.
        min_range_m: Nearest beacon, m.
        max_range_m: Farthest beacon, m.
        costs: Output, shape (KEPT,): minus twice the log likelihood but for a constant.
        chi2s: Output, shape (KEPT,): the part of it from centroids.
        cones: Output, shape (KEPT,): the part from emission cones.
        Rs: Output, rotations, shape (KEPT, 3, 3).
        ts: Output, translations, shape (KEPT, 3), m.
        assignments: Output, blob of each LED, shape (KEPT, 4).

    Returns:
        Number of labelings that survived, in no order; the number of poses that were tried; and the sum of their areas
        within one unit of cost, over pi, px^2.
    """
    m = px.shape[0]
    orders = led_triples.shape[0]
    tried = 0
    area = 0.0
    slopes = np.empty((m, 2, 3))
    ray_slopes(model_id, lens, rays, slopes)
    carried = np.empty((orders, 6, 3))
    edges = np.empty((orders, 3))
    for k in range(orders):
        carried_by(leds, axes, led_triples[k], carried[k])
        for c in range(3):
            a, b = led_triples[k, c // 2], led_triples[k, 1 + (c + 1) // 2]
            edges[k, c] = (
                (leds[a, 0] - leds[b, 0]) ** 2 + (leds[a, 1] - leds[b, 1]) ** 2 + (leds[a, 2] - leds[b, 2]) ** 2
            )
    distances = np.empty((4, 3))
    ranks = np.empty(KEPT)
    kept = np.empty((KEPT, 5), dtype=np.int64)
    kept_m = np.empty((KEPT, 3))
    found = 0
    fullest = 0
    worst = HOPELESS_COST
    reach2 = reach_px * reach_px
    for i0 in range(m):
        r0 = (rays[i0, 0], rays[i0, 1], rays[i0, 2])
        for i1 in range(i0 + 1, m):
            if (px[i0, 0] - px[i1, 0]) ** 2 + (px[i0, 1] - px[i1, 1]) ** 2 > reach2:
                continue
            r1 = (rays[i1, 0], rays[i1, 1], rays[i1, 2])
            for i2 in range(i1 + 1, m):
                if (px[i0, 0] - px[i2, 0]) ** 2 + (px[i0, 1] - px[i2, 1]) ** 2 > reach2:
                    continue
                if (px[i1, 0] - px[i2, 0]) ** 2 + (px[i1, 1] - px[i2, 1]) ** 2 > reach2:
                    continue
                r2 = (rays[i2, 0], rays[i2, 1], rays[i2, 2])
                b0, b1, b2 = dot(r0, r1), dot(r0, r2), dot(r1, r2)
                for k in range(orders):
                    lo0, lo1, lo2 = led_triples[k, 0], led_triples[k, 1], led_triples[k, 2]
                    left = 6 - lo0 - lo1 - lo2
                    for root in range(solve_distances(b0, b1, b2, edges[k, 0], edges[k, 1], edges[k, 2], distances)):
                        d0, d1, d2 = distances[root, 0], distances[root, 1], distances[root, 2]
                        p0 = (d0 * r0[0], d0 * r0[1], d0 * r0[2])
                        p1 = (d1 * r1[0], d1 * r1[1], d1 * r1[2])
                        p2 = (d2 * r2[0], d2 * r2[1], d2 * r2[2])
                        e1 = (p1[0] - p0[0], p1[1] - p0[1], p1[2] - p0[2])
                        e2 = (p2[0] - p0[0], p2[1] - p0[1], p2[2] - p0[2])
                        n = cross(e1, e2)
                        w = combine(carried[k, _ORIGIN], e1, e2, n)
                        w = (p0[0] + w[0], p0[1] + w[1], p0[2] + w[2])
                        square = dot(w, w)
                        if square < min_range_m * min_range_m or square > max_range_m * max_range_m:
                            continue
                        if not shines(p0, combine(carried[k, _AXES], e1, e2, n), cos_loose[lo0]):
                            continue
                        if not shines(p1, combine(carried[k, _AXES + 1], e1, e2, n), cos_loose[lo1]):
                            continue
                        if not shines(p2, combine(carried[k, _AXES + 2], e1, e2, n), cos_loose[lo2]):
                            continue
                        tried += 1
                        w = combine(carried[k, _FOURTH], e1, e2, n)
                        p = (p0[0] + w[0], p0[1] + w[1], p0[2] + w[2])
                        if not shines(p, combine(carried[k, _AXES + 3], e1, e2, n), cos_loose[left]):
                            continue
                        u, v, ok, ux, uy, uz, vx, vy, vz = project_point_with_jacobian(model_id, lens, p[0], p[1], p[2])
                        if not ok:
                            continue
                        s0, s1, s2, fixed = _by_rays((ux, uy, uz), carried[k, _FOURTH], p0, p1, p2, r0, r1, r2)
                        if not fixed:
                            continue
                        q0, q1, q2, _ = _by_rays((vx, vy, vz), carried[k, _FOURTH], p0, p1, p2, r0, r1, r2)
                        ua, ub = _spread(s0, slopes[i0], sigma[i0])
                        uc, ud = _spread(s1, slopes[i1], sigma[i1])
                        ue, uf = _spread(s2, slopes[i2], sigma[i2])
                        va, vb = _spread(q0, slopes[i0], sigma[i0])
                        vc, vd = _spread(q1, slopes[i1], sigma[i1])
                        ve, vf = _spread(q2, slopes[i2], sigma[i2])
                        guess_uu = ua * ua + ub * ub + uc * uc + ud * ud + ue * ue + uf * uf
                        guess_uv = ua * va + ub * vb + uc * vc + ud * vd + ue * ve + uf * vf
                        guess_vv = va * va + vb * vb + vc * vc + vd * vd + ve * ve + vf * vf
                        for b in range(m):
                            if b in (i0, i1, i2):
                                continue
                            uu = guess_uu + sigma[b] * sigma[b]
                            vv = guess_vv + sigma[b] * sigma[b]
                            det = uu * vv - guess_uv * guess_uv
                            area += sqrt(det)
                            du = px[b, 0] - u
                            dv = px[b, 1] - v
                            rank = (vv * du * du - 2.0 * guess_uv * du * dv + uu * dv * dv) / det
                            if rank > worst:
                                continue
                            slot = fullest
                            if found < KEPT:
                                slot = found
                                found += 1
                            ranks[slot] = rank
                            kept[slot, 0], kept[slot, 1], kept[slot, 2] = k, i0, i1
                            kept[slot, 3], kept[slot, 4] = i2, b
                            kept_m[slot, 0], kept_m[slot, 1], kept_m[slot, 2] = d0, d1, d2
                            if found == KEPT:
                                fullest = int(np.argmax(ranks))
                                worst = ranks[fullest]
    three_rays = np.empty((3, 3))
    three_leds = np.empty((3, 3))
    some_px = np.empty((4, 2))
    some_sigma = np.empty(4)
    least = np.inf
    count = 0
    for _ in range(found):
        at = int(np.argmin(ranks[:found]))
        if ranks[at] > _WORTH_REFINING_FLOOR + _WORTH_REFINING * least:
            break
        ranks[at] = np.inf
        k = kept[at, 0]
        R = Rs[count]
        t = ts[count]
        assignment = assignments[count]
        left = 6
        for c in range(4):
            blob = kept[at, 1 + c]
            if c < 3:
                led = led_triples[k, c]
                left -= led
                three_rays[c] = rays[blob]
                three_leds[c] = leds[led]
            else:
                led = left
            assignment[led] = blob
            some_px[led] = px[blob]
            some_sigma[led] = sigma[blob]
        if not pose_from_distances(three_rays, three_leds, kept_m[at, 0], kept_m[at, 1], kept_m[at, 2], R, t):
            continue
        chi2, _, _ = refine_pose(model_id, lens, leds, some_px, some_sigma, R, t, _REFINE_STEPS, 4.0 * HOPELESS_COST)
        if chi2 == np.inf or not t[0] * t[0] + t[1] * t[1] + t[2] * t[2] >= min_range_m * min_range_m:
            continue
        cone = 0.0
        for led in range(4):
            cone += cone_cost(R, t, leds[led], axes[led], cos_limit[led])
        cost = chi2 + cone + appearance_cost(R, t, leds, axes, assignment, looks, look_sigma, exponent)
        least = min(least, cost)
        costs[count] = cost
        chi2s[count] = chi2
        cones[count] = cone
        count += 1
    return count, tried, area
