"""Compiled search over labelings of five LEDs or more: three rays fix a pose, the LEDs around them confirm it.

Every triple of LEDs that can be seen together is laid on every seed, a triple of blobs. A pose is followed up only when
enough LEDs near the triple find a light; then all LEDs are paired, refined, and paired again until nothing changes.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens_kernels import project_point_with_jacobian
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.evidence_kernels import appearance_cost, cone_cost, is_lit
from uvgs_bench.sensor.search_four import KEPT
from uvgs_bench.sensor.seed_frame import lay_out, seed_frame
from uvgs_bench.sensor.solvers.uvgs_lm import refine_pose
from uvgs_bench.sensor.three_rays import pose_from_distances, solve_distances

# A lit LED without a blob: one in twelve is hidden. A blob that is no LED: such a light at just this place is rare.
MISSING_COST = 5.0
STRAY_COST = 15.0
# Gates about predictions: px and share of the seed's span for the LEDs near it, deviations once many are paired.
_GATE_PX = 4.0
_GATE_SHARE = 0.02
_NEAR_SHARE = 0.06
_GATE_SIGMAS = 6.0
_ROUNDS = 5
_REFINE_STEPS = 8
# A pose that explains its LEDs worse than this per degree of freedom is not followed up.
_HOPELESS_PER_DOF = 400.0
# A pose of so many LEDs that fits can end the search, once none that explains as many can have been missed but by this
# chance: a seed falls on neighbours among as many of the lights with at least this share of its square's probability.
_CERTAIN = 6
_CERTAIN_CHI2_PER_DOF = 6.0
_MISSED = 1e-3
_SEED_SHARE = 0.5
# What ranks this much behind the best cannot become a rival.
_WORTH_REFINING = 120.0
_SAME_COSINE = 0.9998
_SAME_SHIFT = 0.02
# So many cells of the size of a gate to each side of a seed show quickly where there is no light at all.
_HALF_CELLS = 64


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
    """Pair each lit LED with the nearest free blob within the larger of a gate and six of the blob's deviations."""
    count = 0
    taken[:] = False
    for led in range(leds.shape[0]):
        assignment[led] = -1
        if not is_lit(R, t, leds[led], axes[led], cos_loose[led]):
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
            gate = max(gate_px, _GATE_SIGMAS * sigma[blob])
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
) -> int:
    """Store a pose among the ``KEPT`` of least rank, of those that are one pose only the best."""
    slot = -1
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
            slot = int(np.argmax(ranks))
            if rank >= ranks[slot]:
                return found
    ranks[slot] = rank
    Rs[slot] = R
    ts[slot] = t
    assignments[slot] = assignment
    return found


@compiled
def search_many(
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
    edges_m2: FloatArray,
    near: NDArray[np.int64],
    seeds: NDArray[np.int64],
    needed: int,
    most_tried: int,
) -> tuple[int, int, float]:
    """Score labelings.

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
        led_triples: Ordered LED triples, shape (k, 3).
        reach_px: Two blobs of one beacon are at most this far apart, px.
        min_range_m: Nearest beacon, m.
        max_range_m: Farthest beacon, m.
        costs: Output, shape (KEPT,): minus twice the log likelihood but for a constant.
        chi2s: Output, shape (KEPT,): the part of it from centroids.
        cones: Output, shape (KEPT,): the part from emission cones.
        Rs: Output, rotations, shape (KEPT, 3, 3).
        ts: Output, translations, shape (KEPT, 3), m.
        assignments: Output, blob of each LED or -1, shape (KEPT, n).
        edges_m2: Squared edges 01, 02, 12 of the LED triples, shape (k, 3), m^2.
        near: The LEDs asked first, by distance from each LED, shape (n, q).
        seeds: Blob triples in the order to try, shape (j, 3).
        needed: How many of those asked must find a light; 1 looks everywhere with a tight gate.
        most_tried: Poses after which no further seed is begun.

    Returns:
        Number of labelings that survived, in no order; the number of poses tried; the chance that a pose explaining as
        many LEDs as the best has been missed, 1 when the best explains too few to tell, 0 when all were tried.
    """
    m = px.shape[0]
    n = leds.shape[0]
    asked = near.shape[1]
    found = 0
    tried = 0
    missed = 1.0
    j = -1
    distances = np.empty((4, 3))
    three_rays = np.empty((3, 3))
    three_leds = np.empty((3, 3))
    assignment = np.empty(n, dtype=np.int64)
    taken = np.empty(m, dtype=np.bool_)
    some_leds = np.empty((n, 3))
    some_px = np.empty((n, 2))
    some_sigma = np.empty(n)
    R = np.empty((3, 3))
    t = np.empty(3)
    R_seed = np.empty((3, 3))
    t_seed = np.empty(3)
    B = np.empty((3, 3))
    xy = np.empty((m, 2))
    half = _HALF_CELLS
    cells = np.empty((2 * half, 2 * half), dtype=np.bool_)
    widest_sigma = np.max(sigma)
    for j in range(seeds.shape[0]):
        if missed < _MISSED or tried > most_tried:
            break
        i0, i1, i2 = seeds[j, 0], seeds[j, 1], seeds[j, 2]
        span = sqrt(
            max(
                (px[i0, 0] - px[i1, 0]) ** 2 + (px[i0, 1] - px[i1, 1]) ** 2,
                (px[i0, 0] - px[i2, 0]) ** 2 + (px[i0, 1] - px[i2, 1]) ** 2,
                (px[i1, 0] - px[i2, 0]) ** 2 + (px[i1, 1] - px[i2, 1]) ** 2,
            )
        )
        if span > reach_px:
            continue
        if needed == 1:
            gate = max(_GATE_PX, _GATE_SHARE * span)
        else:
            gate = 4.0 * widest_sigma + _NEAR_SHARE * span
        seen = seed_frame(rays, seeds[j], B, xy)
        gate *= seen / span
        lay_out(xy, gate, cells)
        for c in range(3):
            blob = seeds[j, c]
            for axis in range(3):
                three_rays[c, axis] = (
                    B[axis, 0] * rays[blob, 0] + B[axis, 1] * rays[blob, 1] + B[axis, 2] * rays[blob, 2]
                )
        b0 = rays[i0, 0] * rays[i1, 0] + rays[i0, 1] * rays[i1, 1] + rays[i0, 2] * rays[i1, 2]
        b1 = rays[i0, 0] * rays[i2, 0] + rays[i0, 1] * rays[i2, 1] + rays[i0, 2] * rays[i2, 2]
        b2 = rays[i1, 0] * rays[i2, 0] + rays[i1, 1] * rays[i2, 1] + rays[i1, 2] * rays[i2, 2]
        for k in range(led_triples.shape[0]):
            l0, l1, l2 = led_triples[k, 0], led_triples[k, 1], led_triples[k, 2]
            for c in range(3):
                three_leds[c] = leds[led_triples[k, c]]
            for root in range(solve_distances(b0, b1, b2, edges_m2[k, 0], edges_m2[k, 1], edges_m2[k, 2], distances)):
                if not pose_from_distances(
                    three_rays, three_leds, distances[root, 0], distances[root, 1], distances[root, 2], R, t
                ):
                    continue
                square = t[0] * t[0] + t[1] * t[1] + t[2] * t[2]
                if square < min_range_m * min_range_m or square > max_range_m * max_range_m:
                    continue
                if not (
                    is_lit(R, t, leds[l0], axes[l0], cos_loose[l0])
                    and is_lit(R, t, leds[l1], axes[l1], cos_loose[l1])
                    and is_lit(R, t, leds[l2], axes[l2], cos_loose[l2])
                ):
                    continue
                tried += 1
                assignment[:] = -1
                assignment[l0], assignment[l1], assignment[l2] = i0, i1, i2
                hits = 0
                for a in range(asked):
                    if hits + asked - a < needed:
                        break
                    led = near[l0, a]
                    if led in (l1, l2):
                        continue
                    x = R[0, 0] * leds[led, 0] + R[0, 1] * leds[led, 1] + R[0, 2] * leds[led, 2] + t[0]
                    y = R[1, 0] * leds[led, 0] + R[1, 1] * leds[led, 1] + R[1, 2] * leds[led, 2] + t[1]
                    z = R[2, 0] * leds[led, 0] + R[2, 1] * leds[led, 1] + R[2, 2] * leds[led, 2] + t[2]
                    if z <= 0.0:
                        continue
                    x /= z
                    y /= z
                    row, column = y / gate + half, x / gate + half
                    if not (0.0 <= row < 2 * half and 0.0 <= column < 2 * half and cells[int(row), int(column)]):
                        continue
                    if not is_lit(R, t, leds[led], axes[led], cos_loose[led]):
                        continue
                    best = gate * gate
                    chosen = -1
                    for blob in range(m):
                        d = (xy[blob, 0] - x) ** 2 + (xy[blob, 1] - y) ** 2
                        if d < best and blob not in (i0, i1, i2):
                            best = d
                            chosen = blob
                    if chosen < 0:
                        continue
                    for other in range(n):
                        if assignment[other] == chosen:
                            chosen = -1
                            break
                    if chosen >= 0:
                        assignment[led] = chosen
                        hits += 1
                if hits < needed:
                    continue
                R_seed[:] = R
                t_seed[:] = t
                for a in range(3):
                    t[a] = B[0, a] * t_seed[0] + B[1, a] * t_seed[1] + B[2, a] * t_seed[2]
                    for b in range(3):
                        R[a, b] = B[0, a] * R_seed[0, b] + B[1, a] * R_seed[1, b] + B[2, a] * R_seed[2, b]
                count = 3 + hits
                _gather(assignment, leds, px, sigma, some_leds, some_px, some_sigma)
                chi2, _, _ = refine_pose(
                    model_id, lens, some_leds[:count], some_px[:count], some_sigma[:count], R, t, _REFINE_STEPS,
                    _HOPELESS_PER_DOF * hits,
                )  # fmt: skip
                if chi2 > _HOPELESS_PER_DOF * (2 * count - 6):
                    continue
                before = -1
                for turn in range(_ROUNDS):
                    count = _assign_near(
                        model_id, lens, px, sigma, leds, axes, cos_loose, R, t, _GATE_PX if turn == 0 else 0.0,
                        assignment, taken,
                    )  # fmt: skip
                    if count < 4 or (turn > 1 and count == before):
                        break
                    before = count
                    _gather(assignment, leds, px, sigma, some_leds, some_px, some_sigma)
                    chi2, _, _ = refine_pose(
                        model_id, lens, some_leds[:count], some_px[:count], some_sigma[:count], R, t, _REFINE_STEPS,
                        np.inf,
                    )  # fmt: skip
                    if chi2 == np.inf:
                        break
                if count < 4 or chi2 == np.inf:
                    continue
                rank = chi2 - (MISSING_COST + STRAY_COST) * count
                found = _keep(found, rank, R, t, assignment, costs, Rs, ts, assignments)
        if found > 0:
            at = int(np.argmin(costs[:found]))
            count = np.sum(assignments[at] >= 0)
            chi2 = costs[at] + (MISSING_COST + STRAY_COST) * count
            if count >= _CERTAIN and chi2 < _CERTAIN_CHI2_PER_DOF * (2 * count - 6):
                missed = (1.0 - _SEED_SHARE * (count / m) ** 2) ** (j + 1)
    if needed == 1 and j + 1 == seeds.shape[0] and tried <= most_tried:
        missed = 0.0
    least = np.min(costs[:found]) if found > 0 else 0.0
    kept = 0
    for i in range(found):
        if costs[i] > least + _WORTH_REFINING:
            continue
        R[:] = Rs[i]
        t[:] = ts[i]
        assignment[:] = assignments[i]
        count = _gather(assignment, leds, px, sigma, some_leds, some_px, some_sigma)
        chi2, _, _ = refine_pose(
            model_id, lens, some_leds[:count], some_px[:count], some_sigma[:count], R, t, 2 * _REFINE_STEPS, np.inf
        )
        if chi2 == np.inf or not t[0] * t[0] + t[1] * t[1] + t[2] * t[2] >= min_range_m * min_range_m:
            continue
        cost = chi2 + appearance_cost(R, t, leds, axes, assignment, looks, look_sigma, exponent)
        cost += STRAY_COST * (m - count)
        cone = 0.0
        for led in range(n):
            if assignment[led] >= 0:
                cone += cone_cost(R, t, leds[led], axes[led], cos_limit[led])
            elif is_lit(R, t, leds[led], axes[led], cos_limit[led]):
                cost += MISSING_COST
        costs[kept] = cost + cone
        chi2s[kept] = chi2
        cones[kept] = cone
        Rs[kept] = R
        ts[kept] = t
        assignments[kept] = assignment
        kept += 1
    return kept, tried, missed
