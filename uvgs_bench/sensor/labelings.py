"""All labelings of a picture's lights, refined and scored, and how many of them chance would give."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, permutations
from math import comb, cos, exp, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import rotation_angle
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.evidence_kernels import look_of_a_stray
from uvgs_bench.sensor.led_table import LedTable, LedTriples
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sensor.search_four import KEPT, search_four
from uvgs_bench.sensor.search_many import search_many
from uvgs_bench.sensor.stray_kernels import STRAY_FACTOR, stray_odds

# Two poses nearer than this are one answer: no user acts differently on them.
_SAME_TURN_RAD = 0.05
_SAME_SHIFT = 0.03
# From one picture to the next the beacon turns and shifts (relative to range) by about this much, one deviation.
STEP_TURN_RAD = 0.07
STEP_SHIFT = 0.05
# A prior speaks for a pose within this many squared deviations, and says nothing about one beyond: it may be carried.
PRIOR_REACH2 = 16.0
# Share of all chance poses that lie so near a prior, at most: a cone of 0.3 rad about one of many attitudes.
_PRIOR_CHANCE = 0.02
# The area within one deviation of an LED predicted from three others, over that of a centroid: typical of triangles.
_PREDICTED_AREA = 4.0
# All ways to call three lights by the names of four LEDs.
_ORDERS = np.array(list(permutations(range(4), 3)), dtype=np.int64)
# The budget of a beacon of many LEDs, a tenth of a second: up to so many triples of LEDs on triples of blobs all are
# tried; else no seed is begun after so many poses, and what is not proven then is refused.
_MOST_IN_FULL = 120_000
_MOST_TRIED = 150_000
# Blobs beside a blob that start a search with it, and neighbours that must find a light.
_NEIGHBOURS = 4
_CONFIRMING = 3
# The best must have been met from two seeds at least: what one alone came to, another may have missed. Its look-alikes
# are all tried, so this guards against rivals nobody can name.
_MOST_MISSED = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """One refined labeling.

    Args:
        cost: Minus twice the log likelihood of all evidence, but for a constant.
        chi2: The part from centroids.
        cone_cost: The part from emission cones.
        pose: The pose.
        blob_of_led: Blob of each LED or -1, shape (n,).
        near_prior: Whether a prior speaks for it.
    """

    cost: float
    chi2: float
    cone_cost: float
    pose: Pose
    blob_of_led: NDArray[np.int64]
    near_prior: bool

    @property
    def seen(self) -> int:
        """Number of LEDs it explains."""
        return int((self.blob_of_led >= 0).sum())


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """What a search found.

    Args:
        cost: Minus twice the log likelihood of all evidence, but for a constant, least first, shape (k,).
        chi2: The part from centroids, shape (k,).
        cone_cost: The part from emission cones, shape (k,).
        near_prior: Whether a prior speaks for it, shape (k,).
        R: Rotations camera_from_beacon, shape (k, 3, 3).
        t_m: Translations, shape (k, 3), m.
        blob_of_led: Blob of each LED or -1, shape (k, n).
        tried: Number of poses tried.
        area_px2: With four LEDs the sum over these poses and blobs of the area within one unit of cost, over pi; with
            more that of one prediction.
        field_px2: Area in which the lights lie.
        blobs: Number of lights.
        is_proven: Whether all labelings were tried, or the best was met again and again and its look-alikes tried.
    """

    cost: FloatArray
    chi2: FloatArray
    cone_cost: FloatArray
    near_prior: NDArray[np.bool_]
    R: FloatArray
    t_m: FloatArray
    blob_of_led: NDArray[np.int64]
    tried: int
    area_px2: float
    field_px2: float
    blobs: int
    is_proven: bool = True

    def __len__(self) -> int:
        return len(self.cost)

    def candidate(self, i: int) -> Candidate:
        """Labeling number ``i``, best first."""
        return Candidate(
            float(self.cost[i]), float(self.chi2[i]), float(self.cone_cost[i]),
            Pose(self.R[i], self.t_m[i], "camera", "beacon"), self.blob_of_led[i], bool(self.near_prior[i]),
        )  # fmt: skip

    def rival(self) -> Candidate | None:
        """The best labeling with a truly different pose than the best."""
        trace = (self.R * self.R[0]).sum(axis=(1, 2))
        shift = np.linalg.norm(self.t_m - self.t_m[0], axis=1)
        turned = trace < 1.0 + 2.0 * cos(_SAME_TURN_RAD)
        different = np.flatnonzero(turned | (shift > _SAME_SHIFT * float(np.linalg.norm(self.t_m[0]))))
        return self.candidate(int(different[0])) if len(different) else None


def chance_fits(best: Candidate, found: Search, leds: LedTable, looks: FloatArray | None) -> float:
    """How many fits as likely as this one lights strewn at random would give.

    For each pose tried, a light strewn evenly over the field falls within a unit of cost of the predicted LED with
    probability pi area / field. That density, over the density a true fit of this cost has, is the answer; a light of
    any brightness or width is as much less likely to look like an LED as its range is wider than the LEDs'.

    Args:
        best: The fit.
        found: The search it came from.
        leds: The tabulated beacon.
        looks: As for ``match_leds``.

    Returns:
        The expected number.
    """
    fit = exp(min(0.5 * (best.chi2 + best.cone_cost), 60.0))
    n, redundant = len(leds.positions_m), best.seen - 3
    if n > 4:
        # Each redundant LED is one of those left, explained by one of the lights left.
        share = min(1.0, 2.0 * pi * found.area_px2 * (found.blobs - 3) / found.field_px2)
        return found.tried * comb(n - 3, redundant) * share**redundant * fit
    # A true fit has two degrees of freedom, so its density is exp(-chi2 / 2) / 2.
    odds = 2.0 * pi * found.area_px2 / found.field_px2 * fit
    if looks is not None:
        odds *= _looks_odds(best, leds, looks)
    return odds * (_PRIOR_CHANCE if best.near_prior else 1.0)


def _looks_odds(best: Candidate, leds: LedTable, looks: FloatArray) -> float:
    """How much likelier the looks are when one of four lights is a stray than when all are LEDs: any may be the one."""
    odds = 1.0
    R, t = best.pose.R.copy(), best.pose.t_m.copy()
    for column in range(2):
        gain = look_of_a_stray(
            R, t, leds.positions_m, leds.axes, best.blob_of_led, looks, leds.look_sigma, leds.exponent, column
        )
        odds *= gain
        if column == 0 and gain != 1.0:
            # One light against the mean of three others. Strays may well be as wide as LEDs, so width has no such gain.
            odds *= sqrt(2.0 * pi * 4.0 / 3.0) * float(leds.look_sigma[0]) / log(STRAY_FACTOR)
    return odds


def odds_of_a_stray(
    best: Candidate,
    found: Search,
    px: FloatArray,
    sigma: FloatArray,
    lens: Lens,
    leds: LedTable,
    config: UvgsConfig,
    looks: FloatArray | None,
) -> float:
    """Likelihood that one of four named lights is a stray over that of all being LEDs, see ``stray_odds``.

    Args:
        best: The fit of four LEDs.
        found: The search it came from.
        px: As for ``match_leds``.
        sigma: As for ``match_leds``.
        lens: As for ``match_leds``.
        leds: The tabulated beacon.
        config: Ranges.
        looks: As for ``match_leds``.

    Returns:
        The ratio, times the number of fours among the lights; where a prior speaks for the
        fit, few of the other poses are as near.
    """
    blobs = best.blob_of_led
    at = np.ascontiguousarray(px[blobs])
    known = np.full((4, 2), np.nan) if looks is None else np.ascontiguousarray(looks[blobs])
    odds = stray_odds(
        lens.model_id, lens.kernel_parameters, np.ascontiguousarray(lens.unproject(at)), at,
        np.ascontiguousarray(sigma[blobs]), known, leds.look_sigma, leds.exponent, leds.positions_m, leds.axes,
        leds.cos_loose, _ORDERS, best.pose.R.copy(), best.pose.t_m.copy(), best.chi2 + best.cone_cost,
        config.min_range_m, config.max_range_m, found.field_px2,
    )  # fmt: skip
    return odds * comb(found.blobs, 4) * (_PRIOR_CHANCE if best.near_prior else 1.0)


def search(
    px: FloatArray,
    sigma: FloatArray,
    lens: Lens,
    leds: LedTable,
    config: UvgsConfig,
    prior: PoseEstimate | None = None,
    looks: FloatArray | None = None,
) -> Search:
    """Refined labelings, best first; arguments as for ``match_leds``."""
    rays = lens.unproject(px)
    seen = np.flatnonzero(np.isfinite(rays[:, 0]))
    if len(seen) < 4:
        none = np.empty(0)
        return Search(
            none, none, none, none.astype(bool), np.empty((0, 3, 3)), np.empty((0, 3)),
            np.empty((0, len(leds.positions_m)), dtype=np.int64), 0, 0.0, 1.0, len(seen),
        )  # fmt: skip
    n = len(leds.positions_m)
    costs, chi2s, cones = np.empty((3, KEPT))
    Rs, ts = np.empty((KEPT, 3, 3)), np.empty((KEPT, 3))
    assignments = np.empty((KEPT, n), dtype=np.int64)
    reach = max(lens.fx_px, lens.fy_px) * leds.longest_m / config.min_range_m
    at, deviations = np.ascontiguousarray(px[seen]), np.ascontiguousarray(sigma[seen])
    known = np.full((len(seen), 2), np.nan) if looks is None else np.ascontiguousarray(looks[seen])
    triples, seeds, needed = _plan(at, leds)
    is_proven = True
    if n == 4:
        count, tried, area = search_four(
            lens.model_id, lens.kernel_parameters, np.ascontiguousarray(rays[seen]), at, deviations, known,
            leds.look_sigma, leds.exponent, leds.positions_m, leds.axes, leds.cos_limit, leds.cos_loose, triples.leds,
            reach, config.min_range_m, config.max_range_m, costs, chi2s, cones, Rs, ts, assignments,
        )  # fmt: skip
    else:
        count, tried, missed = search_many(
            lens.model_id, lens.kernel_parameters, np.ascontiguousarray(rays[seen]), at, deviations, known,
            leds.look_sigma, leds.exponent, leds.positions_m, leds.axes, leds.cos_limit, leds.cos_loose, triples.leds,
            reach, config.min_range_m, config.max_range_m, costs, chi2s, cones, Rs, ts, assignments, triples.edges_m2,
            triples.near, seeds, needed, _MOST_TRIED, leds.turns, leds.shifts_m,
        )  # fmt: skip
        is_proven = missed < _MOST_MISSED
        area = _PREDICTED_AREA * float(np.mean(deviations**2))
    Rs, ts, cost = Rs[:count], ts[:count], costs[:count]
    near = np.zeros(count, dtype=bool)
    if prior is not None:
        step2 = steps_from(prior, Rs, ts)
        # What was weak itself lends no weight: a glint that stays would vouch for itself.
        near = (step2 < PRIOR_REACH2) & ("weak_evidence" not in prior.flags)
        cost = cost + np.minimum(step2, PRIOR_REACH2)
    order = np.argsort(cost, kind="stable")
    named = assignments[order]
    named = np.where(named >= 0, seen[named], -1)
    # The lights lie in their bounding box, widened by as much as the outermost of m lights stay within a field.
    sides = (at.max(axis=0) - at.min(axis=0)) * (len(at) + 1.0) / (len(at) - 1.0)
    field_px2 = max(float(sides[0] * sides[1]), 1.0)
    return Search(
        cost[order], chi2s[order], cones[order], near[order], Rs[order], ts[order], named, tried, area, field_px2,
        len(seen), is_proven,
    )  # fmt: skip


def _plan(px: FloatArray, leds: LedTable) -> tuple[LedTriples, NDArray[np.int64], int]:
    """Which LED triples to lay on which blobs, and how many neighbours must then find a light.

    All on all, the widest blobs first, as long as that is affordable; else triples of neighbouring LEDs on neighbouring
    blobs, which three more neighbours must confirm.
    """
    m = len(px)
    if len(leds.positions_m) == 4:
        return leds.triples, np.empty((0, 3), dtype=np.int64), 1
    if comb(m, 3) * len(leds.triples.leds) <= _MOST_IN_FULL:
        triples = np.array(list(combinations(range(m), 3)), dtype=np.int64)
        return leds.triples, triples[np.argsort(-_area(px, triples)[0], kind="stable")], 1
    near = np.argsort(np.linalg.norm(px[:, None] - px[None], axis=2), axis=1, kind="stable")[:, 1 : 1 + _NEIGHBOURS]
    pairs = np.array(list(combinations(range(near.shape[1]), 2)))
    around = np.concatenate([np.repeat(np.arange(m), len(pairs))[:, None], near[:, pairs].reshape(-1, 2)], axis=1)
    triples = np.unique(np.sort(around, axis=1), axis=0)
    area, longest = _area(px, triples)
    fair = area > 0.2 * longest**2
    triples, longest = triples[fair], longest[fair]
    # The smallest first, but each blob in turn: what stands beside a stray light must not use up the search.
    order = np.argsort(longest, kind="stable")
    turn = np.zeros(m, dtype=np.int64)
    rank = np.empty(len(order), dtype=np.int64)
    for i in order:
        rank[i] = turn[triples[i]].max()
        turn[triples[i]] += 1
    return leds.local, np.ascontiguousarray(triples[np.lexsort((longest, rank))]), _CONFIRMING


def _area(px: FloatArray, triples: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """Twice the area of triangles, px^2, and their longest edges, px."""
    a, b, c = px[triples[:, 0]], px[triples[:, 1]], px[triples[:, 2]]
    area = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    return area, np.max([np.linalg.norm(p, axis=1) for p in (a - b, a - c, b - c)], axis=0)


def steps_from(prior: PoseEstimate, R: FloatArray, t_m: FloatArray) -> FloatArray:
    """How many squared deviations of a step poses are away from a prior.

    Args:
        prior: The last pose.
        R: Rotations camera_from_beacon, shape (k, 3, 3).
        t_m: Translations, shape (k, 3), m.

    Returns:
        Shape (k,).
    """
    last = prior.camera_from_beacon
    turn2 = float(np.mean(prior.rotation_sigma_rad**2)) + STEP_TURN_RAD**2
    range_m = float(np.linalg.norm(last.t_m))
    shift2 = float(np.mean(prior.position_sigma_m**2)) + (STEP_SHIFT * range_m) ** 2
    # |R - S| is 2 sqrt(2) times the sine of half the angle between them: exact near zero.
    half_sine = np.sqrt(((R - last.R) ** 2).sum(axis=(1, 2)) / 8.0)
    angle = 2.0 * np.arcsin(np.minimum(half_sine, 1.0))
    result: FloatArray = angle**2 / turn2 + ((t_m - last.t_m) ** 2).sum(axis=1) / shift2
    return result


def is_near(prior: PoseEstimate, pose: Pose) -> bool:
    """Whether a pose is one step from a prior."""
    return float(steps_from(prior, pose.R[None], pose.t_m[None])[0]) < PRIOR_REACH2


def is_different(a: Pose, b: Pose) -> bool:
    """Whether two poses are two answers to a user."""
    shift = float(np.linalg.norm(a.t_m - b.t_m)) / float(np.linalg.norm(a.t_m))
    return shift > _SAME_SHIFT or rotation_angle(a.R.T @ b.R) > _SAME_TURN_RAD
