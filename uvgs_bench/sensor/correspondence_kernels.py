"""Compiled search over all labelings: P3P on every triple, the other LEDs by prediction, then refinement."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens_kernels import project_point
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.pose_kernels import normal_equations, solve_damped, turn_and_shift
from uvgs_bench.sensor.solvers.lambda_twist import solve_p3p
from uvgs_bench.sensor.solvers.uvgs_lm import refine_pose

KEPT = 64
# A visible LED that no blob stands for costs as much as a residual of five deviations.
_MISSING_COST = 25.0
# One step from the P3P pose: beyond this no refinement brings a labeling back (12 px at 0.25 px deviation).
HOPELESS_COST = 2500.0
_REFINE_STEPS = 15


@compiled
def _is_lit(R: FloatArray, t: FloatArray, led: FloatArray, axis: FloatArray, cos_limit: float) -> bool:
    """Whether the camera lies within the emission cone of an LED."""
    if cos_limit <= -1.0:
        return True
    dot = 0.0
    norm = 0.0
    for i in range(3):
        p = R[i, 0] * led[0] + R[i, 1] * led[1] + R[i, 2] * led[2] + t[i]
        d = R[i, 0] * axis[0] + R[i, 1] * axis[1] + R[i, 2] * axis[2]
        dot -= p * d
        norm += p * p
    return dot >= cos_limit * sqrt(norm)


@compiled
def _assign_rest(
    model_id: int,
    lens: FloatArray,
    px: FloatArray,
    leds: FloatArray,
    axes: FloatArray,
    cos_loose: FloatArray,
    R: FloatArray,
    t: FloatArray,
    gate_px: float,
    assignment: NDArray[np.int64],
) -> int:
    """Give each unassigned lit LED the nearest free blob within the gate. Returns the number assigned, or -1."""
    count = 0
    for led in range(leds.shape[0]):
        lit = _is_lit(R, t, leds[led], axes[led], cos_loose[led])
        if assignment[led] >= 0:
            if not lit:
                return -1
            count += 1
            continue
        if not lit:
            continue
        x = R[0, 0] * leds[led, 0] + R[0, 1] * leds[led, 1] + R[0, 2] * leds[led, 2] + t[0]
        y = R[1, 0] * leds[led, 0] + R[1, 1] * leds[led, 1] + R[1, 2] * leds[led, 2] + t[1]
        z = R[2, 0] * leds[led, 0] + R[2, 1] * leds[led, 1] + R[2, 2] * leds[led, 2] + t[2]
        u, v, ok = project_point(model_id, lens, x, y, z)
        if not ok:
            continue
        best = gate_px * gate_px
        chosen = -1
        for blob in range(px.shape[0]):
            taken = False
            for other in range(leds.shape[0]):
                if assignment[other] == blob:
                    taken = True
            if taken:
                continue
            d = (px[blob, 0] - u) ** 2 + (px[blob, 1] - v) ** 2
            if d < best:
                best = d
                chosen = blob
        if chosen >= 0:
            assignment[led] = chosen
            count += 1
    return count


@compiled
def search_labelings(
    model_id: int,
    lens: FloatArray,
    rays: FloatArray,
    px: FloatArray,
    sigma: FloatArray,
    leds: FloatArray,
    axes: FloatArray,
    cos_limit: FloatArray,
    cos_loose: FloatArray,
    triples: NDArray[np.int64],
    reach_px: float,
    min_range_m: float,
    max_range_m: float,
    costs: FloatArray,
    chi2s: FloatArray,
    Rs: FloatArray,
    ts: FloatArray,
    assignments: NDArray[np.int64],
) -> tuple[int, int]:
    """Score labelings: every ordered triple of blobs against the given LED triples.

    Args:
        model_id: Lens model number.
        lens: Lens parameters for kernels.
        rays: Unit rays of the blobs, shape (m, 3).
        px: Centroids, shape (m, 2), raw px.
        sigma: Their deviations including model error, shape (m,), px.
        leds: LED positions, shape (n, 3), m.
        axes: Emission axes, shape (n, 3).
        cos_limit: Cosine of the widest visible angle, shape (n,); -2 for an LED that shines everywhere.
        cos_loose: The same with room for the error of a P3P start.
        triples: LED triples to start from, shape (k, 3).
        reach_px: Two blobs of one beacon are at most this far apart, px.
        min_range_m: Nearest beacon, m.
        max_range_m: Farthest beacon, m.
        costs: Output, shape (KEPT,): chi-square plus the price of missing LEDs.
        chi2s: Output, shape (KEPT,): chi-square.
        Rs: Output, rotations, shape (KEPT, 3, 3).
        ts: Output, translations, shape (KEPT, 3), m.
        assignments: Output, blob of each LED or -1, shape (KEPT, n).

    Returns:
        Number of labelings that survived, in no order, and how many came within ``HOPELESS_COST`` at all.
    """
    m = px.shape[0]
    n = leds.shape[0]
    found = 0
    worst = 0
    passed = 0
    p3p_R = np.empty((4, 3, 3))
    p3p_t = np.empty((4, 3))
    three_rays = np.empty((3, 3))
    three_leds = np.empty((3, 3))
    assignment = np.empty(n, dtype=np.int64)
    some_leds = np.empty((n, 3))
    some_px = np.empty((n, 2))
    some_sigma = np.empty(n)
    H = np.empty((6, 6))
    g = np.empty(6)
    L = np.zeros((6, 6))
    step = np.zeros(6)
    residual = np.empty((n, 2))
    R_new = np.empty((3, 3))
    t_new = np.empty(3)
    for k in range(triples.shape[0]):
        for c in range(3):
            three_leds[c] = leds[triples[k, c]]
        for b0 in range(m):
            for b1 in range(m):
                if b1 == b0:
                    continue
                d01 = sqrt((px[b0, 0] - px[b1, 0]) ** 2 + (px[b0, 1] - px[b1, 1]) ** 2)
                if d01 > reach_px:
                    continue
                for b2 in range(m):
                    if b2 in (b0, b1):
                        continue
                    d02 = sqrt((px[b0, 0] - px[b2, 0]) ** 2 + (px[b0, 1] - px[b2, 1]) ** 2)
                    d12 = sqrt((px[b1, 0] - px[b2, 0]) ** 2 + (px[b1, 1] - px[b2, 1]) ** 2)
                    span = max(d01, max(d02, d12))
                    if span > reach_px:
                        continue
                    three_rays[0] = rays[b0]
                    three_rays[1] = rays[b1]
                    three_rays[2] = rays[b2]
                    gate = max(8.0, 0.4 * span)
                    for pose in range(solve_p3p(three_rays, three_leds, p3p_R, p3p_t)):
                        R = p3p_R[pose]
                        t = p3p_t[pose]
                        distance = sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
                        if distance < min_range_m or distance > max_range_m:
                            continue
                        assignment[:] = -1
                        assignment[triples[k, 0]] = b0
                        assignment[triples[k, 1]] = b1
                        assignment[triples[k, 2]] = b2
                        count = _assign_rest(model_id, lens, px, leds, axes, cos_loose, R, t, gate, assignment)
                        if count < 4:
                            continue
                        j = 0
                        for led in range(n):
                            if assignment[led] >= 0:
                                some_leds[j] = leds[led]
                                some_px[j] = px[assignment[led]]
                                some_sigma[j] = sigma[assignment[led]]
                                j += 1
                        args_leds = some_leds[:count]
                        args_px = some_px[:count]
                        args_sigma = some_sigma[:count]
                        cost = normal_equations(model_id, lens, args_leds, args_px, args_sigma, R, t, t, H, g, residual)
                        if cost == np.inf or not solve_damped(H, g, 1e-6, step, L):
                            continue
                        turn_and_shift(R, t, step, R_new, t_new)
                        new_cost = normal_equations(
                            model_id, lens, args_leds, args_px, args_sigma, R_new, t_new, t_new, H, g, residual
                        )
                        cost = min(cost, new_cost)
                        if cost > HOPELESS_COST * (count - 3):
                            continue
                        passed += 1
                        rank = cost / (count - 3) - 1e3 * count
                        if found < KEPT:
                            slot = found
                            found += 1
                        elif rank < costs[worst]:
                            slot = worst
                        else:
                            continue
                        costs[slot] = rank
                        Rs[slot] = R
                        ts[slot] = t
                        assignments[slot] = assignment
                        if found == KEPT:
                            worst = 0
                            for i in range(1, KEPT):
                                if costs[i] > costs[worst]:
                                    worst = i
    kept = 0
    for i in range(found):
        R = Rs[i]
        t = ts[i]
        count = 0
        for led in range(n):
            if assignments[i, led] >= 0:
                some_leds[count] = leds[led]
                some_px[count] = px[assignments[i, led]]
                some_sigma[count] = sigma[assignments[i, led]]
                count += 1
        chi2, _, _ = refine_pose(
            model_id, lens, some_leds[:count], some_px[:count], some_sigma[:count], R, t, _REFINE_STEPS, 2500.0
        )
        if chi2 == np.inf or not sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2) >= min_range_m:
            continue
        cost = chi2
        lit = True
        for led in range(n):
            visible = _is_lit(R, t, leds[led], axes[led], cos_limit[led])
            if assignments[i, led] >= 0 and not visible:
                lit = False
            if assignments[i, led] < 0 and visible:
                cost += _MISSING_COST
        if not lit:
            continue
        costs[kept] = cost
        chi2s[kept] = chi2
        Rs[kept] = R
        ts[kept] = t
        assignments[kept] = assignments[i]
        kept += 1
    return kept, passed
