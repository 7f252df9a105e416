"""Compiled pairing of many LEDs with lights about a pose, and the best poses kept while a search runs."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens_kernels import project_point_with_jacobian
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.evidence_kernels import is_lit
from uvgs_bench.sensor.solvers.uvgs_lm import refine_pose

# A lit LED without a blob: one in twelve is hidden. A blob that is no LED: such a light at just this place is rare.
MISSING_COST = 5.0
STRAY_COST = 15.0
GATE_PX = 4.0
_GATE_SIGMAS = 6.0
_ROUNDS = 5
_REFINE_STEPS = 8
# A pose that explains its LEDs worse than this per degree of freedom is not followed up.
_HOPELESS_PER_DOF = 400.0
_SAME_COSINE = 0.9998
_SAME_SHIFT = 0.02
# Beside an axis so near the line of sight no direction across it is left.
_NO_SIGHT_M = 1e-9


@compiled
def copy_pose(R: FloatArray, t: FloatArray, R_out: FloatArray, t_out: FloatArray) -> None:
    """Copy a pose by elements: assignments of slices cost half a second of compilation each."""
    for i in range(3):
        t_out[i] = t[i]
        for j in range(3):
            R_out[i, j] = R[i, j]


@compiled
def least(values: FloatArray, count: int) -> int:
    """Place of the least of the first ``count`` values."""
    at = 0
    for i in range(1, count):
        if values[i] < values[at]:
            at = i
    return at


@compiled
def assign_near(
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
    taken: FloatArray,
) -> int:
    """Pair each lit LED with the nearest blob within the larger of a gate and six of the blob's deviations.

    Of LEDs nearest to one blob the nearest has it: without cones, hidden LEDs lie about everywhere. ``taken`` is space
    for squared distances, shape (m,).
    """
    count = 0
    for blob in range(px.shape[0]):
        taken[blob] = np.inf
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
            if d < best and d < gate * gate:
                best = d
                chosen = blob
        if chosen < 0 or best >= taken[chosen]:
            continue
        if taken[chosen] < np.inf:
            for other in range(led):
                if assignment[other] == chosen:
                    assignment[other] = -1
            count -= 1
        assignment[led] = chosen
        taken[chosen] = best
        count += 1
    return count


@compiled
def refine_paired(
    model_id: int,
    lens: FloatArray,
    px: FloatArray,
    sigma: FloatArray,
    leds: FloatArray,
    assignment: NDArray[np.int64],
    R: FloatArray,
    t: FloatArray,
    steps: int,
    give_up_chi2: float,
) -> tuple[float, int]:
    """Refine a pose in place on the LEDs that have a blob. Returns chi-square (inf when it fails) and their number."""
    n = leds.shape[0]
    some_leds = np.empty((n, 3))
    some_px = np.empty((n, 2))
    some_sigma = np.empty(n)
    count = 0
    for led in range(n):
        blob = assignment[led]
        if blob >= 0:
            for i in range(3):
                some_leds[count, i] = leds[led, i]
            some_px[count, 0] = px[blob, 0]
            some_px[count, 1] = px[blob, 1]
            some_sigma[count] = sigma[blob]
            count += 1
    if count < 3:
        return np.inf, count
    chi2, _, _ = refine_pose(
        model_id, lens, some_leds[:count], some_px[:count], some_sigma[:count], R, t, steps, give_up_chi2
    )
    return chi2, count


@compiled
def settle(
    model_id: int,
    lens: FloatArray,
    px: FloatArray,
    sigma: FloatArray,
    leds: FloatArray,
    axes: FloatArray,
    cos_loose: FloatArray,
    assignment: NDArray[np.int64],
    taken: FloatArray,
    R: FloatArray,
    t: FloatArray,
) -> tuple[float, int]:
    """Refine on a first pairing, then pair all LEDs anew and refine until nothing changes, in place.

    Returns chi-square, inf when it comes to nothing, and the number of LEDs paired.
    """
    first = 0
    for led in range(leds.shape[0]):
        first += assignment[led] >= 0
    chi2, count = refine_paired(
        model_id, lens, px, sigma, leds, assignment, R, t, _REFINE_STEPS, _HOPELESS_PER_DOF * (first - 3)
    )
    if chi2 > _HOPELESS_PER_DOF * (2 * count - 6):
        return np.inf, count
    before = -1
    for turn in range(_ROUNDS):
        gate_px = GATE_PX if turn == 0 else 0.0
        count = assign_near(model_id, lens, px, sigma, leds, axes, cos_loose, R, t, gate_px, assignment, taken)
        if count < 4:
            return np.inf, count
        if turn > 1 and count == before:
            break
        before = count
        chi2, _ = refine_paired(model_id, lens, px, sigma, leds, assignment, R, t, _REFINE_STEPS, np.inf)
        if chi2 == np.inf:
            break
    return chi2, count


@compiled
def keep(
    found: int,
    rank: float,
    seed: int,
    R: FloatArray,
    t: FloatArray,
    assignment: NDArray[np.int64],
    ranks: FloatArray,
    Rs: FloatArray,
    ts: FloatArray,
    assignments: NDArray[np.int64],
    met: NDArray[np.int64],
) -> int:
    """Store a pose among those of least rank, of those that are one pose only the best.

    ``met`` counts for each pose the seeds that came to it, and holds the last of them, shape (k, 2).
    """
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
        if met[i, 1] != seed:
            met[i, 0] += 1
            met[i, 1] = seed
        if ranks[i] <= rank:
            return found
        slot = i
        break
    if slot < 0:
        if found < ranks.shape[0]:
            slot = found
            found += 1
        else:
            slot = 0
            for i in range(1, found):
                if ranks[i] > ranks[slot]:
                    slot = i
            if rank >= ranks[slot]:
                return found
        met[slot, 0] = 1
        met[slot, 1] = seed
    ranks[slot] = rank
    copy_pose(R, t, Rs[slot], ts[slot])
    for led in range(assignment.shape[0]):
        assignments[slot, led] = assignment[led]
    return found


@compiled
def take_look_alike(
    R: FloatArray, t: FloatArray, middle: FloatArray, S: FloatArray, s: FloatArray, R_out: FloatArray, t_out: FloatArray
) -> None:
    """The pose of a beacon moved by S, s that looks alike; a mirroring is seen from behind, through its middle.

    Args:
        R: Rotation camera_from_beacon, shape (3, 3).
        t: Translation, shape (3,), m.
        middle: Middle of the LEDs seen, beacon frame, shape (3,), m.
        S: Orthogonal, shape (3, 3).
        s: Shift, shape (3,), m.
        R_out: Output, shape (3, 3).
        t_out: Output, shape (3,), m.
    """
    sight = np.empty(3)
    norm = 0.0
    for i in range(3):
        sight[i] = R[i, 0] * middle[0] + R[i, 1] * middle[1] + R[i, 2] * middle[2] + t[i]
        norm += sight[i] ** 2
    volume = (
        S[0, 0] * (S[1, 1] * S[2, 2] - S[1, 2] * S[2, 1])
        - S[0, 1] * (S[1, 0] * S[2, 2] - S[1, 2] * S[2, 0])
        + S[0, 2] * (S[1, 0] * S[2, 1] - S[1, 1] * S[2, 0])
    )
    for i in range(3):
        t_out[i] = R[i, 0] * s[0] + R[i, 1] * s[1] + R[i, 2] * s[2] + t[i]
        for j in range(3):
            R_out[i, j] = R[i, 0] * S[0, j] + R[i, 1] * S[1, j] + R[i, 2] * S[2, j]
    if volume > 0.0 or norm < _NO_SIGHT_M**2:
        return
    # Mirror depth about the middle: x - 2 v v.(x - c) with v along c, so that v.c is the length of c.
    along = 2.0 * (sight[0] * t_out[0] + sight[1] * t_out[1] + sight[2] * t_out[2]) / norm - 2.0
    for i in range(3):
        t_out[i] -= along * sight[i]
    for j in range(3):
        along = 2.0 * (sight[0] * R_out[0, j] + sight[1] * R_out[1, j] + sight[2] * R_out[2, j]) / norm
        for i in range(3):
            R_out[i, j] -= along * sight[i]
