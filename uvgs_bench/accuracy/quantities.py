"""The figures laboratories ask for by name, each with its definition, its source and an interval that holds.

What a run cannot give is given as NaN with the reason, so that a report is silent about nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.clusters import Clusters, Estimate
from uvgs_bench.accuracy.error_groups import groups
from uvgs_bench.accuracy.intervals import moment_intervals
from uvgs_bench.accuracy.iso_figures import (
    LEAST_CYCLES,
    angular_repeatability,
    direction_variation,
    drift,
    pose_accuracy,
    pose_repeatability,
    precision,
)
from uvgs_bench.accuracy.motion import dynamic_figures, lag_of
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.order_intervals import fraction_interval, max_interval, quantile_interval, tolerance_bound
from uvgs_bench.accuracy.pairs import distance_figures, pair_rms, place_pairs, relative_errors
from uvgs_bench.accuracy.pose_error import ErrorTable
from uvgs_bench.accuracy.quantity_catalogue import TEXTS, Quantity, quantity
from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.geometry import FloatArray
from uvgs_bench.units import NS_PER_S, rad_from_deg

__all__ = ["Quantity", "quantities"]

# A pose this unlikely under its own covariance (5 sigma of one figure), and off by this much, is a false fix.
_FALSE_NEES = 39.8
_FALSE_RANGE_SHARE = 0.03
_FALSE_ATTITUDE_RAD = rad_from_deg(10.0)
_NOBODY = "no capture at rest has a pose"

Found = Iterator[tuple[str, Estimate]]


def quantities(
    obs: Observations, table: ErrorTable, registration: Registration, rng: np.random.Generator
) -> tuple[Quantity, ...]:
    """All named figures of the captures that judge.

    Args:
        obs: The captures, misses included, in the order of ``table``.
        table: Their errors.
        registration: The registration that predicted them.
        rng: Source of randomness for the intervals; the same seed gives the same figures.

    Returns:
        One quantity per key of ``TEXTS`` that is of a whole run, in that order; then the groups.
    """
    is_moving = obs.is_moving
    resting = table.is_solved & ~is_moving
    still = table.select(resting)
    found: dict[str, Estimate] = {}
    if still.count:
        clusters = Clusters.of(still.place, rng)
        for part in (
            _absolute(still, clusters),
            _relative(still),
            _iso_9283(still, obs.approach[resting], clusters),
            _over_time(obs, still, resting, clusters),
        ):
            found.update(part)
    found["availability"] = _fraction(table.is_solved, table.place)
    found["false_fix"] = _false_fixes(table)
    moving = table.is_solved & is_moving
    passing = table.select(moving)
    found["lag"] = lag_of(obs.select(moving), passing, registration)
    found.update(dynamic_figures(passing, obs.session[moving], rng))
    nothing = Estimate(np.nan, 0.0, np.inf, 0, 0, _NOBODY)
    whole = [quantity(key, found.get(key, nothing)) for key in TEXTS if key not in _ELSEWHERE]
    return tuple(whole) + tuple(_grouped(table, obs, rng))


_ELSEWHERE = frozenset({"two_cluster_position_rms", "two_cluster_attitude_rms", "position_rms", "attitude_rms"})


def _absolute(still: ErrorTable, clusters: Clusters) -> Found:
    for key, errors, columns in (
        ("position", still.translation_error_m, slice(3, 6)),
        ("attitude", still.rotation_error_rad, slice(0, 3)),
    ):
        yield f"absolute_{key}_rms", moment_intervals(errors, still.registration_factor[:, columns], clusters).rms
        yield f"{key}_tolerance_95", tolerance_bound(np.linalg.norm(errors, axis=1), 0.95, clusters)


def _relative(still: ErrorTable) -> Found:
    pairs = place_pairs(still.place)
    shift, turn, factor = relative_errors(still, pairs)
    yield "relative_position_rms", pair_rms(shift, factor[:, 3:], pairs)
    yield "relative_attitude_rms", pair_rms(turn, factor[:, :3], pairs)
    observed = still.predicted_t_m + still.translation_error_m
    accuracy, repeatability = distance_figures(observed, still.predicted_t_m, pairs)
    yield "ad_rms", accuracy
    yield "rd_rms", repeatability


def _iso_9283(still: ErrorTable, approach: NDArray[np.int8], clusters: Clusters) -> Found:
    shift, turn = still.translation_error_m, still.rotation_error_rad
    rows = [np.flatnonzero(clusters.index == s) for s in range(clusters.count)]
    enough = [at for at in rows if len(at) >= LEAST_CYCLES]
    cycles = int(np.median([len(at) for at in enough])) if enough else 0
    few = f"{cycles} captures at a typical place; the standard asks for 30" if 0 < cycles < 30 else ""
    none = f"needs places with {LEAST_CYCLES} captures or more"
    one_way = "needs places that were reached from more than one direction"
    # The registration's error moves places together; no comparison of places shows it.
    shared_m = float(np.sqrt((still.registration_sigma_m**2).mean()))
    shared_rad = float(np.sqrt((still.registration_sigma_rad**2).mean()))

    median, largest = _over_places(rows, lambda at: pose_accuracy(shift[at]), _NOBODY, shared=shared_m)
    yield "ap_position_median", median
    yield "ap_position_max", largest
    yield "ap_attitude_max", _over_places(rows, lambda at: pose_accuracy(turn[at]), _NOBODY, shared=shared_rad)[1]
    median, largest = _over_places(enough, lambda at: pose_repeatability(shift[at]), none, few)
    yield "rp_position_median", median
    yield "rp_position_max", largest
    yield "rp_attitude_max", _over_places(enough, lambda at: angular_repeatability(turn[at]), none, few)[1]
    yield "vap_position", _over_places(rows, lambda at: direction_variation(shift[at], approach[at]), one_way)[1]


def _over_places(
    places: list[NDArray[np.intp]],
    figure: Callable[[NDArray[np.intp]], float],
    reason: str,
    note: str = "",
    shared: float = 0.0,
) -> tuple[Estimate, Estimate]:
    """Median and largest over places of a figure that each place has; ``shared`` is a doubt common to all of them."""
    values = np.array([figure(at) for at in places])
    known = np.isfinite(values)
    if not known.any():
        nothing = Estimate(np.nan, 0.0, np.inf, 0, 0, reason)
        return nothing, nothing
    chosen = Clusters.counted(np.flatnonzero(known))
    captures = sum(len(at) for at, is_known in zip(places, known.tolist(), strict=True) if is_known)

    def told(e: Estimate) -> Estimate:
        low = max(e.value - float(np.hypot(e.value - e.low, 2.0 * shared)), 0.0)
        high = e.value + float(np.hypot(e.high - e.value, 2.0 * shared))
        notes = "; ".join(filter(None, (e.note, note)))
        return Estimate(e.value, low, high, e.station_count, captures, notes, e.effective_count)

    of_median = quantile_interval(values[known], 0.5, chosen)
    return told(of_median), told(max_interval(values[known], chosen, "places"))


def _over_time(obs: Observations, still: ErrorTable, resting: NDArray[np.bool_], clusters: Clusters) -> Found:
    run = obs.session[resting]
    t_s = (still.t_ns - still.t_ns[0]) / NS_PER_S
    span_s = float(np.ptp(t_s))
    if len(np.unique(run)) > 1:
        several = Estimate(np.nan, 0.0, np.inf, 0, 0, "several runs: drift is of one run")
        yield "drift_position", several
        yield "drift_attitude", several
    else:
        for key, errors in (("position", still.translation_error_m), ("attitude", still.rotation_error_rad)):
            yield f"drift_{key}", drift(errors, t_s, still.place, still.station, span_s)
    found = precision(still.translation_error_m, clusters, run)
    yield "repeatability_sd", found.within
    yield "between_runs_sd", found.between
    yield "reproducibility_sd", found.total
    yield "repeatability_limit", found.limits[0]
    yield "reproducibility_limit", found.limits[1]


def _fraction(flags: NDArray[np.bool_], place: NDArray[np.int64]) -> Estimate:
    if len(flags) == 0:
        return Estimate(np.nan, 0.0, 1.0, 0, 0, "no captures")
    return fraction_interval(flags, Clusters.counted(place))


def _false_fixes(table: ErrorTable) -> Estimate:
    poses = table.select(table.is_solved)
    is_far = (poses.position_error_m > _FALSE_RANGE_SHARE * poses.range_m) | (
        poses.attitude_error_rad > _FALSE_ATTITUDE_RAD
    )
    return _fraction((poses.nees > _FALSE_NEES) & is_far, poses.place)


def _grouped(table: ErrorTable, obs: Observations, rng: np.random.Generator) -> Iterator[Quantity]:
    for grouping, words, mask in groups(table, obs.exposure_s):
        part = table.select(mask)
        yield quantity("availability", _fraction(part.is_solved, part.place), grouping, words)
        solved = part.select(part.is_solved)
        if solved.count == 0:
            continue
        clusters = Clusters.of(solved.place, rng)
        for key, errors, columns in _figures(solved):
            moments = moment_intervals(errors, solved.registration_factor[:, columns], clusters)
            yield quantity(key, moments.rms, grouping, words)


def _figures(solved: ErrorTable) -> tuple[tuple[str, FloatArray, slice], ...]:
    return (
        ("position_rms", solved.translation_error_m, slice(3, 6)),
        ("attitude_rms", solved.rotation_error_rad, slice(0, 3)),
    )
