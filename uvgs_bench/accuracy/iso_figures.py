"""Pose accuracy and repeatability of places, drift, and repeatability between runs, from plain errors.

Source: ISO 9283 (AP, RP, vAP, drift) and ISO 5725-2 (repeatability, reproducibility) as usually published; intervals
of sums of variances: F. Graybill and C.-M. Wang, Confidence intervals on nonnegative linear combinations of variances,
1980.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.clusters import LEAST_PLACES, TAIL, Clusters, Estimate
from uvgs_bench.accuracy.distributions import chi2_quantile, f_quantile
from uvgs_bench.accuracy.intervals import directions, ratio_interval
from uvgs_bench.geometry import FloatArray

LEAST_CYCLES = 3
"""Captures of a place below which its repeatability is not computed."""
LEAST_RUNS = 3
"""Runs below which what differs between runs has no upper end."""
_LIMIT = 2.8


def pose_accuracy(errors: FloatArray) -> float:
    """``AP_P``: length of the mean error of one place.

    Args:
        errors: Measured less reference position of each cycle, shape (n, 3), m.

    Returns:
        AP, m.
    """
    return float(np.linalg.norm(errors.mean(axis=0)))


def pose_repeatability(errors: FloatArray) -> float:
    """``RP_l = lbar + 3 S_l`` of one place, ``l`` the distances of the cycles from their barycentre.

    Args:
        errors: Measured less reference position of each cycle, shape (n, 3), n >= 2, m.

    Returns:
        RP, m.
    """
    distance = np.linalg.norm(errors - errors.mean(axis=0), axis=1)
    return float(distance.mean() + 3.0 * distance.std(ddof=1))


def angular_repeatability(turns: FloatArray) -> float:
    """Largest ``3 S`` of the residual rotation vectors' components of one place.

    Args:
        turns: Residual rotation vectors, shape (n, 3), n >= 2, rad.

    Returns:
        RP of the worst axis, rad.
    """
    return float(3.0 * turns.std(axis=0, ddof=1).max())


def direction_variation(errors: FloatArray, approach: NDArray[np.int8]) -> float:
    """``vAP``: largest distance between the mean errors of one place reached from different directions.

    Args:
        errors: Measured less reference position, shape (n, 3), m.
        approach: Sign of the last motion of each axis, shape (n, A).

    Returns:
        vAP, m; NaN when all come from one direction or it is not known.
    """
    known = (approach != 0).any(axis=1)
    if not known.any():
        return float("nan")
    ways = np.unique(approach[known], axis=0)
    if len(ways) < 2:
        return float("nan")
    means = np.array([errors[(approach == way).all(axis=1)].mean(axis=0) for way in ways])
    return float(np.linalg.norm(means[:, None] - means[None], axis=2).max())


def drift(
    errors: FloatArray, t_s: FloatArray, place: NDArray[np.int64], station: NDArray[np.int64], span_s: float
) -> Estimate:
    """Length of the straight-line change of an error vector over a span of time, from places visited again.

    Means of visits are fitted with one level per place and one slope: what differs between places is not drift.

    Args:
        errors: Error vectors, shape (n, 3).
        t_s: Instants, shape (n,), s.
        place: Place of each capture, shape (n,).
        station: Visit of each capture, shape (n,).
        span_s: The time the change is stated for, s.

    Returns:
        The length with its interval; the counts are those of the visits' places.
    """
    visits, of_visit, size = np.unique(station, return_inverse=True, return_counts=True)
    V = len(visits)
    means = np.stack([np.bincount(of_visit, column, V) / size for column in errors.T], axis=1)
    instant = np.bincount(of_visit, t_s, V) / size
    at = np.empty(V, dtype=np.int64)
    at[of_visit] = place
    _, index, count = np.unique(at, return_inverse=True, return_counts=True)
    again = count[index] > 1
    used = len(np.unique(at[again]))
    captures = int(size[again].sum())
    if not again.any():
        return Estimate(np.nan, 0.0, np.inf, 0, 0, "no place was visited again")
    means, instant, index = means[again], instant[again], np.unique(index[again], return_inverse=True)[1]
    per_place = np.bincount(index)
    tau = instant - (np.bincount(index, instant) / per_place)[index]
    level = np.stack([np.bincount(index, column) / per_place for column in means.T], axis=1)
    centred = means - level[index]
    power = float(tau @ tau)
    degrees = len(means) - len(level) - 1
    if power <= 0.0 or degrees < 1:
        note = f"{len(means)} visits of {used} places visited again: at least {LEAST_PLACES} more visits than places"
        return Estimate(np.nan, 0.0, np.inf, used, captures, note)
    slope = tau @ centred / power
    value = float(np.linalg.norm(slope)) * span_s
    if degrees < LEAST_PLACES - 1:
        note = f"{len(means)} visits of {used} places visited again: at least {LEAST_PLACES} more visits than places"
        return Estimate(value, 0.0, np.inf, used, captures, note)
    residual = centred - tau[:, None] * slope
    variance = float((residual**2).sum(axis=0).max()) / degrees / power
    reach = float(np.sqrt(3.0 * f_quantile(1.0 - 2.0 * TAIL, 3, max(degrees - 2, 1)) * variance)) * span_s
    return Estimate(value, max(value - reach, 0.0), value + reach, used, captures)


@dataclass(frozen=True, slots=True)
class Precision:
    """Repeatability within and reproducibility between runs, per axis."""

    within: Estimate
    between: Estimate
    total: Estimate

    @property
    def limits(self) -> tuple[Estimate, Estimate]:
        """``r = 2.8 s_r`` and ``R = 2.8 s_R``."""
        return self.within.scaled(_LIMIT), self.total.scaled(_LIMIT)


def precision(errors: FloatArray, clusters: Clusters, run: NDArray[np.int64]) -> Precision:
    """One-way layout of runs by places, pooled over places and axes.

    What a run adds may be the same at all places, so runs, not cells, are counted in the interval of what is between.

    Args:
        errors: Error vectors, shape (n, 3), m.
        clusters: Their places.
        run: Run of each capture, shape (n,).

    Returns:
        s_r, s_L and s_R, standard deviations per axis.
    """
    told = clusters.estimate
    cells, cell, size = np.unique(np.stack([clusters.index, run]), axis=1, return_inverse=True, return_counts=True)
    cell = cell.reshape(-1)
    n, C, d, P = len(errors), len(size), errors.shape[1], clusters.count
    places, runs = cells[0], len(np.unique(run))
    nothing = told(np.nan, 0.0, np.inf, "needs places with two captures or more in one run")
    if n == C:
        return Precision(nothing, nothing, nothing)
    means = np.stack([np.bincount(cell, column, C) / size for column in errors.T], axis=1)
    inside = ((errors - means[cell]) ** 2).sum(axis=1)
    within = float(inside.sum()) / (d * (n - C))
    s_r = clusters.unbounded(np.sqrt(within))
    w_low = w_high = 1.0
    if s_r is None:
        freedom = d * (clusters.size - np.bincount(places, minlength=P))
        _, low, high = ratio_interval(clusters.sums(inside), freedom, clusters)
        s_r = told(np.sqrt(within), np.sqrt(low), np.sqrt(high))
        if within > 0.0:
            w_low, w_high = low / within, high / within
    in_runs = np.bincount(places, minlength=P)
    repeated = in_runs[places] > 1
    if runs < 2 or not repeated.any():
        alone = told(np.nan, 0.0, np.inf, "needs repeated runs of the same places, this is one run")
        return Precision(s_r, alone, alone)
    weight = np.where(repeated, size, 0.0)
    total = np.bincount(places, weight, P)
    grand = np.stack([np.bincount(places, weight * c, P) for c in means.T], axis=1) / np.maximum(total, 1.0)[:, None]
    effects = means - grand[places]
    degrees = int((in_runs - 1)[in_runs > 1].sum())
    between = float((weight[:, None] * effects**2).sum()) / (d * degrees)
    per_cell = float(total.sum() - (np.bincount(places, weight**2, P) / np.maximum(total, 1.0)).sum()) / degrees
    s_L2 = max(between - within, 0.0) / per_cell
    s_R2 = s_L2 + within
    if runs < LEAST_RUNS or P < LEAST_PLACES:
        note = f"only {runs} runs, at least {LEAST_RUNS} are needed for an interval" if runs < LEAST_RUNS else s_r.note
        return Precision(s_r, told(np.sqrt(s_L2), 0.0, np.inf, note), told(np.sqrt(s_R2), 0.0, np.inf, note))
    of_run = np.unique(cells[1], return_inverse=True)[1]
    shares = weight / np.maximum(np.bincount(of_run, weight, runs), 1.0)[of_run]
    added: FloatArray = np.zeros((runs, d))
    np.add.at(added, of_run, shares[:, None] * effects)
    b_low, b_high = _chi2_ends(directions(added) * (runs - 1))
    share, rest = 1.0 / per_cell, 1.0 - 1.0 / per_cell
    low = max(between * b_low - within * w_high, 0.0) / per_cell
    high = max(between * b_high - within * w_low, 0.0) / per_cell
    down = np.hypot(share * between * (1.0 - b_low), rest * within * (1.0 - w_low))
    up = np.hypot(share * between * (b_high - 1.0), rest * within * (w_high - 1.0))
    return Precision(
        s_r,
        told(np.sqrt(s_L2), np.sqrt(min(low, s_L2)), np.sqrt(max(high, s_L2))),
        told(np.sqrt(s_R2), np.sqrt(max(s_R2 - down, 0.0)), np.sqrt(s_R2 + up)),
    )


def _chi2_ends(freedom: float) -> tuple[float, float]:
    """Factors from a mean square to the ends of the interval of its variance."""
    least = chi2_quantile(TAIL, freedom)
    return freedom / chi2_quantile(1.0 - TAIL, freedom), freedom / least if least > 0.0 else float("inf")
