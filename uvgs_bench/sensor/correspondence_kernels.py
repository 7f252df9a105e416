"""Compiled search over labelings: P3P on triples, the other LEDs by prediction, refinement, then all evidence."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens_kernels import project_point_with_jacobian
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.evidence_kernels import appearance_cost, cone_cost, is_lit
from uvgs_bench.sensor.pose_kernels import normal_equations, solve_damped, turn_and_shift
from uvgs_bench.sensor.solvers.lambda_twist import solve_p3p
from uvgs_bench.sensor.solvers.uvgs_lm import refine_pose

KEPT = 64
# A lit LED without a blob: one in twelve is hidden. A blob that is no LED: such a light at just this place is rare.
MISSING_COST = 5.0
STRAY_COST = 15.0
# Predicted to first order; beyond this no refinement brings a labeling back.
HOPELESS_COST = 2500.0
_REFINE_STEPS = 15
# First order overstates a cost by less than this factor where it matters; what starts above is no rival.
_WORTH_REFINING = 40.0
_WORTH_REFINING_FLOOR = 625.0
# Beacons of many LEDs: gates about predictions, px and share of the triple's span, then deviations.
_GATE_PX = 4.0
_GATE_SHARE = 0.02
_GATE_SIGMAS = 6.0
# As many LEDs explained beyond a triple, and half of all, leave nothing to chance; further triples are not tried.
_CERTAIN_BEYOND = 3
_CERTAIN_CHI2_PER_DOF = 6.0
# Seconds of work: beyond this many poses the search stops, and chance is judged by what was tried.
_MOST_TRIED = 2_000_000
_SAME_COSINE = 0.9998
_SAME_SHIFT = 0.02


@compiled
def _predict(
    model_id: int,
    lens: FloatArray,
    led: FloatArray,
    R: FloatArray,
    t: FloatArray,
    L: FloatArray,
    out: FloatArray,
) -> bool:
    """Where an LED is seen from a pose and how surely: out = u, v, and the covariance's uu, uv, vv from the pose.

    L is the lower Cholesky factor of the pose's information about a turn about the beacon's origin.
    """
    qx = R[0, 0] * led[0] + R[0, 1] * led[1] + R[0, 2] * led[2]
    qy = R[1, 0] * led[0] + R[1, 1] * led[1] + R[1, 2] * led[2]
    qz = R[2, 0] * led[0] + R[2, 1] * led[1] + R[2, 2] * led[2]
    u, v, ok, ux, uy, uz, vx, vy, vz = project_point_with_jacobian(model_id, lens, qx + t[0], qy + t[1], qz + t[2])
    if not ok:
        return False
    out[0] = u
    out[1] = v
    a = (uz * qy - uy * qz, ux * qz - uz * qx, uy * qx - ux * qy, ux, uy, uz)
    b = (vz * qy - vy * qz, vx * qz - vz * qx, vy * qx - vx * qy, vx, vy, vz)
    uu = 0.0
    uv = 0.0
    vv = 0.0
    ya = np.empty(6)
    yb = np.empty(6)
    for i in range(6):
        sa = a[i]
        sb = b[i]
        for k in range(i):
            sa -= L[i, k] * ya[k]
            sb -= L[i, k] * yb[k]
        ya[i] = sa / L[i, i]
        yb[i] = sb / L[i, i]
        uu += ya[i] * ya[i]
        uv += ya[i] * yb[i]
        vv += yb[i] * yb[i]
    out[2] = uu
    out[3] = uv
    out[4] = vv
    return True


@compiled
def _assign_near(
    model_id: int,
    lens: FloatArray,
    px: FloatArray,
    sigma: FloatArray,
    leds: FloatArray,
    axes: FloatArray,
    cos_loose: FloatArray,
    R: FloatArray,
    t: FloatArray,
    gate_px: float,
    assignment: NDArray[np.int64],
    taken: NDArray[np.bool_],
) -> int:
    """Give each unassigned lit LED the nearest free blob within the gate (0: six of the blob's deviations)."""
    count = 0
    taken[:] = False
    for led in range(leds.shape[0]):
        if assignment[led] >= 0:
            taken[assignment[led]] = True
            count += 1
    for led in range(leds.shape[0]):
        if assignment[led] >= 0 or not is_lit(R, t, leds[led], axes[led], cos_loose[led]):
            continue
        x = R[0, 0] * leds[led, 0] + R[0, 1] * leds[led, 1] + R[0, 2] * leds[led, 2] + t[0]
        y = R[1, 0] * leds[led, 0] + R[1, 1] * leds[led, 1] + R[1, 2] * leds[led, 2] + t[1]
        z = R[2, 0] * leds[led, 0] + R[2, 1] * leds[led, 1] + R[2, 2] * leds[led, 2] + t[2]
        u, v, ok, _, _, _, _, _, _ = project_point_with_jacobian(model_id, lens, x, y, z)
        if not ok:
            continue
        best = np.inf
        chosen = -1
        for blob in range(px.shape[0]):
            gate = gate_px if gate_px > 0.0 else _GATE_SIGMAS * sigma[blob]
            d = (px[blob, 0] - u) ** 2 + (px[blob, 1] - v) ** 2
            if d < best and d < gate * gate and not taken[blob]:
                best = d
                chosen = blob
        if chosen >= 0:
            assignment[led] = chosen
            taken[chosen] = True
            count += 1
    return count


@compiled
def _gather(
    assignment: NDArray[np.int64],
    leds: FloatArray,
    px: FloatArray,
    sigma: FloatArray,
    some_leds: FloatArray,
    some_px: FloatArray,
    some_sigma: FloatArray,
) -> int:
    """Copy what an assignment pairs into the first rows. Returns their number."""
    count = 0
    for led in range(leds.shape[0]):
        if assignment[led] >= 0:
            some_leds[count] = leds[led]
            some_px[count] = px[assignment[led]]
            some_sigma[count] = sigma[assignment[led]]
            count += 1
    return count


@compiled
def _keep(
    found: int,
    rank: float,
    R: FloatArray,
    t: FloatArray,
    assignment: NDArray[np.int64],
    ranks: FloatArray,
    Rs: FloatArray,
    ts: FloatArray,
    assignments: NDArray[np.int64],
    merges: bool,
) -> int:
    """Store a start among the ``KEPT`` of least rank; with ``merges`` only the best of starts that are one pose."""
    slot = -1
    if merges:
        far = _SAME_SHIFT * sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
        for i in range(found):
            if abs(ts[i, 0] - t[0]) + abs(ts[i, 1] - t[1]) + abs(ts[i, 2] - t[2]) > far:
                continue
            trace = 0.0
            for a in range(3):
                for b in range(3):
                    trace += Rs[i, a, b] * R[a, b]
            if trace < 1.0 + 2.0 * _SAME_COSINE:
                continue
            if ranks[i] <= rank:
                return found
            slot = i
            break
    if slot < 0:
        if found < KEPT:
            slot = found
            found += 1
        else:
            # Not np.argmax, which brings scipy along when it is loaded.
            slot = 0
            for i in range(1, ranks.shape[0]):
                if ranks[i] > ranks[slot]:
                    slot = i
            if rank >= ranks[slot]:
                return found
    ranks[slot] = rank
    Rs[slot] = R
    ts[slot] = t
    assignments[slot] = assignment
    return found


@compiled
def search_labelings(
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
    blob_triples: NDArray[np.int64],
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
    """Score labelings: every triple of blobs against every ordered triple of LEDs.

    With four LEDs the fourth is predicted with its uncertainty from the triple, and each blob near it is a labeling;
    its innovation is to first order the cost of the refined fit, so only what can matter is refined. With more LEDs
    all that are predicted near a blob are paired, and the search ends early once far more LEDs are explained than
    chance could.

    Args:
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        rays: Unit rays of the blobs, shape (m, 3).
        px: Centroids, shape (m, 2), raw px.
        sigma: Their deviations including model error, shape (m,), px.
        looks: Logarithms of light and width of the blobs, shape (m, 2), NaN where unknown.
        look_sigma: Their deviations, shape (2,); 0 leaves one out.
        exponent: Exponent of the emission.
        leds: LED positions, shape (n, 3), m.
        axes: Emission axes, shape (n, 3).
        cos_limit: Cosine of the widest visible angle, shape (n,); -2 for an LED that shines everywhere.
        cos_loose: The same with room beyond it.
        led_triples: Ordered LED triples to start from, shape (k, 3).
        blob_triples: Unordered blob triples in the order to try, shape (j, 3).
        reach_px: Two blobs of one beacon are at most this far apart, px.
        min_range_m: Nearest beacon, m.
        max_range_m: Farthest beacon, m.
        costs: Output, shape (KEPT,): minus twice the log likelihood but for a constant.
        chi2s: Output, shape (KEPT,): the part of it from centroids.
        cones: Output, shape (KEPT,): the part from emission cones.
        Rs: Output, rotations, shape (KEPT, 3, 3).
        ts: Output, translations, shape (KEPT, 3), m.
        assignments: Output, blob of each LED or -1, shape (KEPT, n).

    Returns:
        Number of labelings that survived, in no order; the number of poses that were tried; and the sum of their areas
        within one unit of cost, over pi, px^2.
    """
    m = px.shape[0]
    n = leds.shape[0]
    found = 0
    tried = 0
    area = 0.0
    p3p_R = np.empty((4, 3, 3))
    p3p_t = np.empty((4, 3))
    three_rays = np.empty((3, 3))
    three_leds = np.empty((3, 3))
    three_px = np.empty((3, 2))
    three_sigma = np.empty(3)
    assignment = np.empty(n, dtype=np.int64)
    taken = np.empty(m, dtype=np.bool_)
    some_leds = np.empty((n, 3))
    some_px = np.empty((n, 2))
    some_sigma = np.empty(n)
    H = np.empty((6, 6))
    g = np.empty(6)
    L = np.zeros((6, 6))
    step = np.zeros(6)
    guess = np.empty(5)
    residual = np.empty((n, 2))
    R_new = np.empty((3, 3))
    t_new = np.empty(3)
    certain = False
    for j in range(blob_triples.shape[0]):
        if certain or tried > _MOST_TRIED:
            break
        span = 0.0
        for c in range(3):
            a = blob_triples[j, c]
            b = blob_triples[j, (c + 1) % 3]
            span = max(span, (px[a, 0] - px[b, 0]) ** 2 + (px[a, 1] - px[b, 1]) ** 2)
        span = sqrt(span)
        if span > reach_px:
            continue
        for c in range(3):
            b = blob_triples[j, c]
            three_rays[c] = rays[b]
            three_px[c] = px[b]
            three_sigma[c] = sigma[b]
        for k in range(led_triples.shape[0]):
            for c in range(3):
                three_leds[c] = leds[led_triples[k, c]]
            for pose in range(solve_p3p(three_rays, three_leds, p3p_R, p3p_t)):
                R = p3p_R[pose]
                t = p3p_t[pose]
                distance = sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
                if distance < min_range_m or distance > max_range_m:
                    continue
                lit = True
                for c in range(3):
                    led = led_triples[k, c]
                    lit = lit and is_lit(R, t, leds[led], axes[led], cos_loose[led])
                if not lit:
                    continue
                tried += 1
                assignment[:] = -1
                for c in range(3):
                    assignment[led_triples[k, c]] = blob_triples[j, c]
                if n == 4:
                    led = 6 - led_triples[k, 0] - led_triples[k, 1] - led_triples[k, 2]
                    if not is_lit(R, t, leds[led], axes[led], cos_loose[led]):
                        continue
                    chi2 = normal_equations(model_id, lens, three_leds, three_px, three_sigma, R, t, t, H, g, residual)
                    if chi2 == np.inf or not solve_damped(H, g, 1e-9, step, L):
                        continue
                    if not _predict(model_id, lens, leds[led], R, t, L, guess):
                        continue
                    for b in range(m):
                        if b in (blob_triples[j, 0], blob_triples[j, 1], blob_triples[j, 2]):
                            continue
                        uu = guess[2] + sigma[b] * sigma[b]
                        vv = guess[4] + sigma[b] * sigma[b]
                        det = uu * vv - guess[3] * guess[3]
                        area += sqrt(det)
                        du = px[b, 0] - guess[0]
                        dv = px[b, 1] - guess[1]
                        rank = (vv * du * du - 2.0 * guess[3] * du * dv + uu * dv * dv) / det
                        if rank > HOPELESS_COST:
                            continue
                        assignment[led] = b
                        found = _keep(found, rank, R, t, assignment, costs, Rs, ts, assignments, False)
                    continue
                gate = max(_GATE_PX, _GATE_SHARE * span)
                count = _assign_near(model_id, lens, px, sigma, leds, axes, cos_loose, R, t, gate, assignment, taken)
                if count < 4:
                    continue
                _gather(assignment, leds, px, sigma, some_leds, some_px, some_sigma)
                chi2 = normal_equations(
                    model_id, lens, some_leds[:count], some_px[:count], some_sigma[:count], R, t, t, H, g, residual
                )
                if chi2 == np.inf or not solve_damped(H, g, 1e-6, step, L):
                    continue
                turn_and_shift(R, t, step, R_new, t_new)
                chi2 = normal_equations(
                    model_id, lens, some_leds[:count], some_px[:count], some_sigma[:count],
                    R_new, t_new, t_new, H, g, residual,
                )  # fmt: skip
                if chi2 > HOPELESS_COST * (count - 3):
                    continue
                if count > 4:
                    # Within six deviations of the better pose: drops what was near by accident, finds what was missed.
                    assignment[:] = -1
                    count = _assign_near(
                        model_id, lens, px, sigma, leds, axes, cos_loose, R_new, t_new, 0.0, assignment, taken
                    )
                    if count < 4:
                        continue
                    _gather(assignment, leds, px, sigma, some_leds, some_px, some_sigma)
                    chi2 = normal_equations(
                        model_id, lens, some_leds[:count], some_px[:count], some_sigma[:count],
                        R_new, t_new, t_new, H, g, residual,
                    )  # fmt: skip
                rank = chi2 - (MISSING_COST + STRAY_COST) * count
                found = _keep(found, rank, R_new, t_new, assignment, costs, Rs, ts, assignments, True)
                enough = 3 + max(_CERTAIN_BEYOND, (min(m, n) - 3) // 2)
                if count >= enough and chi2 < _CERTAIN_CHI2_PER_DOF * (2 * count - 6):
                    certain = True
    order = np.argsort(costs[:found])
    ranks = costs[:found].copy()
    R_kept = Rs[:found].copy()
    t_kept = ts[:found].copy()
    a_kept = assignments[:found].copy()
    kept = 0
    least = np.inf
    for i in order:
        if n == 4 and ranks[i] > _WORTH_REFINING_FLOOR + _WORTH_REFINING * least:
            break
        R = R_kept[i]
        t = t_kept[i]
        assignment[:] = a_kept[i]
        count = _gather(assignment, leds, px, sigma, some_leds, some_px, some_sigma)
        chi2, _, _ = refine_pose(
            model_id, lens, some_leds[:count], some_px[:count], some_sigma[:count], R, t, _REFINE_STEPS, 2500.0 * n
        )
        if n > 4 and chi2 < np.inf:
            for led in range(n):
                assignment[led] = -1
            count = _assign_near(model_id, lens, px, sigma, leds, axes, cos_loose, R, t, 0.0, assignment, taken)
            if count < 4:
                continue
            _gather(assignment, leds, px, sigma, some_leds, some_px, some_sigma)
            chi2, _, _ = refine_pose(
                model_id, lens, some_leds[:count], some_px[:count], some_sigma[:count], R, t, _REFINE_STEPS, np.inf
            )
        if chi2 == np.inf or not sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2) >= min_range_m:
            continue
        cost = chi2 + appearance_cost(R, t, leds, axes, assignment, looks, look_sigma, exponent)
        if n > 4:
            cost += STRAY_COST * (m - count)
        cone = 0.0
        for led in range(n):
            if assignment[led] >= 0:
                cone += cone_cost(R, t, leds[led], axes[led], cos_limit[led])
            elif is_lit(R, t, leds[led], axes[led], cos_limit[led]):
                cost += MISSING_COST
        cost += cone
        least = min(least, cost)
        costs[kept] = cost
        chi2s[kept] = chi2
        cones[kept] = cone
        Rs[kept] = R
        ts[kept] = t
        assignments[kept] = assignment
        kept += 1
    return kept, tried, area
