"""Compiled search over labelings of five LEDs or more: three rays fix a pose, the LEDs around them confirm it.

Every triple of LEDs that can be seen together is laid on every seed, a triple of blobs. A pose is followed up only when
enough LEDs near the triple find a light; then all LEDs are paired, refined, and paired again until nothing changes.
What the best pose could be mistaken for, because the beacon looks like itself, is then tried by name.
"""

from __future__ import annotations

from math import exp, sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.evidence_kernels import appearance_cost, cone_cost, is_lit
from uvgs_bench.sensor.pairing_kernels import (
    GATE_PX,
    MISSING_COST,
    STRAY_COST,
    assign_near,
    copy_pose,
    keep,
    least,
    refine_paired,
    settle,
    take_look_alike,
)
from uvgs_bench.sensor.seed_frame import lay_out, seed_frame
from uvgs_bench.sensor.three_rays import pose_from_distances, solve_distances

# Gates about predictions: share of the seed's span when all LEDs are asked and when those near it are.
_GATE_SHARE = 0.02
_NEAR_SHARE = 0.06
# A pose of so many LEDs that fits can end the search, once none that explains as many can have been missed but by this
# chance.
_CERTAIN = 6
_CERTAIN_CHI2_PER_DOF = 6.0
_MISSED = 1e-3
# What ranks this much behind the best cannot become a rival.
_WORTH_REFINING = 120.0
# So many cells of the size of a gate to each side of a seed show quickly where there is no light at all.
_HALF_CELLS = 64
# Look-alikes are sought about so many of the best poses, with gates of this share of the picture of the beacon.
_MISTAKEN = 2
_MISTAKEN_SHARES = (0.03, 0.1)


@compiled
def _add_look_alikes(
    model_id: int,
    lens: FloatArray,
    px: FloatArray,
    sigma: FloatArray,
    leds: FloatArray,
    axes: FloatArray,
    cos_loose: FloatArray,
    turns: FloatArray,
    shifts: FloatArray,
    found: int,
    ranks: FloatArray,
    Rs: FloatArray,
    ts: FloatArray,
    assignments: NDArray[np.int64],
    met: NDArray[np.int64],
) -> int:
    """Settle what the best poses could be mistaken for, and keep it among them. Returns how many are kept then."""
    n = leds.shape[0]
    assignment = np.empty(n, dtype=np.int64)
    taken = np.empty(px.shape[0])
    R0, t0, R, t = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    middle = np.empty(3)
    waiting = ranks[:found].copy()
    for _ in range(min(_MISTAKEN, found)):
        at = least(waiting, waiting.shape[0])
        waiting[at] = np.inf
        copy_pose(Rs[at], ts[at], R0, t0)
        count = 0
        extent = 0.0
        first = -1
        for i in range(3):
            middle[i] = 0.0
        for led in range(n):
            blob = assignments[at, led]
            if blob < 0:
                continue
            if first < 0:
                first = blob
            extent = max(extent, abs(px[blob, 0] - px[first, 0]) + abs(px[blob, 1] - px[first, 1]))
            count += 1
            for i in range(3):
                middle[i] += (leds[led, i] - middle[i]) / count
        for k in range(turns.shape[0]):
            for share in _MISTAKEN_SHARES:
                take_look_alike(R0, t0, middle, turns[k], shifts[k], R, t)
                gate_px = max(GATE_PX, share * extent)
                count = assign_near(model_id, lens, px, sigma, leds, axes, cos_loose, R, t, gate_px, assignment, taken)
                if count < 4:
                    continue
                chi2, count = settle(model_id, lens, px, sigma, leds, axes, cos_loose, assignment, taken, R, t)
                if chi2 < np.inf:
                    rank = chi2 - (MISSING_COST + STRAY_COST) * count
                    found = keep(found, rank, -1, R, t, assignment, ranks, Rs, ts, assignments, met)
    return found


@compiled
def _score(
    model_id: int,
    lens: FloatArray,
    px: FloatArray,
    sigma: FloatArray,
    looks: FloatArray,
    look_sigma: FloatArray,
    exponent: float,
    leds: FloatArray,
    axes: FloatArray,
    cos_limit: FloatArray,
    min_range_m: float,
    found: int,
    costs: FloatArray,
    chi2s: FloatArray,
    cones: FloatArray,
    Rs: FloatArray,
    ts: FloatArray,
    assignments: NDArray[np.int64],
) -> int:
    """Refine what is kept and weigh all evidence, in place. Returns how many are left."""
    n = leds.shape[0]
    lowest = costs[least(costs, found)] if found > 0 else 0.0
    kept = 0
    R, t = np.empty((3, 3)), np.empty(3)
    for i in range(found):
        if costs[i] > lowest + _WORTH_REFINING:
            continue
        copy_pose(Rs[i], ts[i], R, t)
        chi2, count = refine_paired(model_id, lens, px, sigma, leds, assignments[i], R, t, 16, np.inf)
        if chi2 == np.inf or not t[0] * t[0] + t[1] * t[1] + t[2] * t[2] >= min_range_m * min_range_m:
            continue
        cost = chi2 + appearance_cost(R, t, leds, axes, assignments[i], looks, look_sigma, exponent)
        cost += STRAY_COST * (px.shape[0] - count)
        cone = 0.0
        for led in range(n):
            assignments[kept, led] = assignments[i, led]
            if assignments[i, led] >= 0:
                cone += cone_cost(R, t, leds[led], axes[led], cos_limit[led])
            elif is_lit(R, t, leds[led], axes[led], cos_limit[led]):
                cost += MISSING_COST
        costs[kept] = cost + cone
        chi2s[kept] = chi2
        cones[kept] = cone
        copy_pose(R, t, Rs[kept], ts[kept])
        kept += 1
    return kept


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
    turns: FloatArray,
    shifts: FloatArray,
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
        turns: What lays the beacon nearly on itself, shape (q, 3, 3).
        shifts: The same, shape (q, 3), m.

    Returns:
        Number of labelings that survived, in no order; the number of poses tried; the chance that a pose explaining as
        many LEDs as the best has been missed: as seldom as the best itself was met, so 1/e when one seed came to it; 1
        when the best explains too few to tell, 0 when all were tried.
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
    taken = np.empty(m)
    R = np.empty((3, 3))
    t = np.empty(3)
    R_out = np.empty((3, 3))
    t_out = np.empty(3)
    met = np.zeros((costs.shape[0], 2), dtype=np.int64)
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
            gate = max(GATE_PX, _GATE_SHARE * span)
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
                for axis in range(3):
                    three_leds[c, axis] = leds[led_triples[k, c], axis]
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
                for led in range(n):
                    assignment[led] = -1
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
                for a in range(3):
                    t_out[a] = B[0, a] * t[0] + B[1, a] * t[1] + B[2, a] * t[2]
                    for b in range(3):
                        R_out[a, b] = B[0, a] * R[0, b] + B[1, a] * R[1, b] + B[2, a] * R[2, b]
                chi2, count = settle(model_id, lens, px, sigma, leds, axes, cos_loose, assignment, taken, R_out, t_out)
                if chi2 < np.inf:
                    rank = chi2 - (MISSING_COST + STRAY_COST) * count
                    found = keep(found, rank, j, R_out, t_out, assignment, costs, Rs, ts, assignments, met)
        if found > 0:
            at = least(costs, found)
            count = 0
            for led in range(n):
                count += assignments[at, led] >= 0
            chi2 = costs[at] + (MISSING_COST + STRAY_COST) * count
            missed = 1.0
            if count >= _CERTAIN and chi2 < _CERTAIN_CHI2_PER_DOF * (2 * count - 6):
                missed = exp(-float(met[at, 0]))
    if needed == 1 and j + 1 == seeds.shape[0] and tried <= most_tried:
        missed = 0.0
    found = _add_look_alikes(
        model_id, lens, px, sigma, leds, axes, cos_loose, turns, shifts, found, costs, Rs, ts, assignments, met
    )
    kept = _score(
        model_id, lens, px, sigma, looks, look_sigma, exponent, leds, axes, cos_limit, min_range_m, found, costs, chi2s,
        cones, Rs, ts, assignments,
    )  # fmt: skip
    return kept, tried, missed
