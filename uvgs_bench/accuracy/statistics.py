"""Figures of merit with intervals that respect that captures of one station are not independent."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Literal

import numpy as np

from uvgs_bench.accuracy.clusters import Clusters, Estimate
from uvgs_bench.accuracy.distributions import chi2_quantile
from uvgs_bench.accuracy.error_groups import groups
from uvgs_bench.accuracy.intervals import moment_intervals, ratio_interval, within_and_between
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.order_intervals import fraction_interval, max_interval, quantile_interval
from uvgs_bench.accuracy.pose_error import ErrorTable
from uvgs_bench.accuracy.time_blocks import independent_parts

__all__ = [
    "AccuracySummary",
    "Availability",
    "ComponentStatistics",
    "Consistency",
    "Estimate",
    "availability",
    "summarise",
]

Unit = Literal["m", "rad"]
Honesty = Literal["consistent", "inconclusive", "inconsistent"]

_COMPONENTS: dict[str, tuple[Unit, tuple[int, ...]]] = {
    "lateral_x": ("m", (0,)),
    "lateral_y": ("m", (1,)),
    "depth": ("m", (2,)),
    "lateral": ("m", (0, 1)),
    "position": ("m", (0, 1, 2)),
    "tilt_x": ("rad", (0,)),
    "tilt_y": ("rad", (1,)),
    "roll": ("rad", (2,)),
    "attitude": ("rad", (0, 1, 2)),
}
_DOF = 6
_OUTLIER = 5.0
# Mean squared errors over stated variances between these: sigmas right within the root of 2.
_TRUSTED = (0.5, 2.0)
# Median of the chi-squared distribution with 6 degrees of freedom.
_MEDIAN_NEES = 5.348


@dataclass(frozen=True, slots=True)
class ComponentStatistics:
    """Statistics of one component or magnitude of the error.

    For a single axis: bias is the signed mean, spread the standard deviation about it, and median, p95 and max are
    of the absolute value. For a magnitude (lateral, position, attitude): bias is the length of the mean error vector,
    spread the root of the trace of the covariance. Always ``rms^2 = bias^2 + spread^2`` (population form).

    Args:
        name: ``lateral_x lateral_y depth lateral position tilt_x tilt_y roll attitude``.
        unit: ``m`` or ``rad``.
        bias: Trueness.
        spread: Precision about the mean, over stations and captures.
        rms: Root mean square.
        median: Median of the absolute value.
        p95: 95th percentile of the absolute value.
        max: Largest absolute value.
        within_station: Standard deviation of the captures of one station about their mean (repeatability).
        between_stations: Standard deviation of the station effects (what repeating a capture does not average away).
    """

    name: str
    unit: Unit
    bias: Estimate
    spread: Estimate
    rms: Estimate
    median: Estimate
    p95: Estimate
    max: Estimate
    within_station: Estimate
    between_stations: Estimate


@dataclass(frozen=True, slots=True)
class Availability:
    """How often there was a pose.

    Args:
        fraction: Captures with a pose over captures attempted, 0 to 1.
        attempted: Captures attempted.
        solved: Captures with a pose.
        reasons: Number of misses by ``stage/reason``, most frequent first.
    """

    fraction: Estimate
    attempted: int
    solved: int
    reasons: dict[str, int]


@dataclass(frozen=True, slots=True)
class Consistency:
    """Whether the sensor's own covariance tells the truth.

    Args:
        mean_nees_over_6: Mean of the squared error over the predicted covariance, over 6; 1 is perfect, more is
            overconfident, with its interval over stations.
        band_low: Lower end of the 95 % band expected for as many independent stations.
        band_high: Upper end.
        verdict: ``consistent`` when the figure lies in the band and its interval shows stated sigmas to be right
            within a factor of 1.4; ``inconsistent`` when the interval misses the band; else ``inconclusive``.
        reason: The verdict in words, without its name.
    """

    mean_nees_over_6: Estimate
    band_low: float
    band_high: float
    verdict: Honesty
    reason: str


@dataclass(frozen=True, slots=True)
class AccuracySummary:
    """All figures of one set of captures.

    Args:
        components: Statistics by name, in the order of ``ComponentStatistics.name``.
        consistency: The check of the sensor's covariance.
        registration_share_m: What the registration's own doubt adds to the position errors, root mean square, m.
        registration_share_rad: The same for the attitude errors, rad.
        range_min_m: Smallest predicted range among the captures with a pose, m.
        range_max_m: Largest, m.
        station_count: Stations at rest with a pose (those that revisit a place count once).
        capture_count: Captures with a pose.
        outlier_count: Captures further off than five times the usual distance; they are included in every figure.
        consistency_by_range: The check of the covariance by range, from near to far: range in words, result; empty
            when all captures are about equally far.
        moving_count: Captures with a pose taken in motion; they count as no station.
        block_count: Blocks of time they were parted into, each independent of the others.
    """

    components: dict[str, ComponentStatistics]
    consistency: Consistency
    registration_share_m: float
    registration_share_rad: float
    range_min_m: float
    range_max_m: float
    station_count: int
    capture_count: int
    outlier_count: int
    consistency_by_range: tuple[tuple[str, Consistency], ...] = ()
    moving_count: int = 0
    block_count: int = 0

    @property
    def extent(self) -> str:
        """What the figures rest on, in words: captures in motion are never counted as stations."""
        parts = [_counted(self.station_count, "station")] if self.station_count else []
        parts += [f"{_counted(self.block_count, 'block')} of motion"] if self.block_count else []
        return " and ".join(parts)


def availability(obs: Observations, rng: np.random.Generator) -> Availability:
    """How often there was a pose, over all captures given.

    Args:
        obs: Captures, misses included.
        rng: Source of randomness.

    Returns:
        The fraction with its interval, and the reasons of the misses.
    """
    if obs.count == 0:
        return Availability(Estimate(np.nan, 0.0, 1.0, 0, 0, "no captures"), 0, 0, {})
    part = independent_parts(obs.place, obs.is_moving, obs.t_ns, obs.session, obs.is_solved[:, None].astype(np.float64))
    fraction = fraction_interval(obs.is_solved, Clusters.of(part, rng))
    reasons = Counter(reason for reason, solved in zip(obs.reason, obs.is_solved, strict=True) if not solved)
    ordered = dict(sorted(reasons.items(), key=lambda item: (-item[1], item[0])))
    return Availability(fraction, obs.count, int(obs.is_solved.sum()), ordered)


def summarise(table: ErrorTable, rng: np.random.Generator) -> AccuracySummary | None:
    """All figures of a set of captures.

    Args:
        table: Errors; misses are left out, and captures in motion are parted into blocks of time.
        rng: Source of randomness for the intervals; the same seed gives the same intervals.

    Returns:
        The figures, or None when no capture has a pose.
    """
    solved = table.select(table.is_solved).in_blocks()
    if solved.count == 0:
        return None
    at_rest = len(np.unique(solved.place[~solved.is_moving]))
    clusters = Clusters.of(solved.place, rng)
    still = solved.select(~solved.is_moving)
    at_stations = clusters if still.count == solved.count else Clusters.of(still.place, rng)
    components = {}
    for name, (unit, axes) in _COMPONENTS.items():
        chosen = list(axes)
        errors = (solved.translation_error_m if unit == "m" else solved.rotation_error_rad)[:, chosen]
        factor = solved.registration_factor[:, [axis + (3 if unit == "m" else 0) for axis in axes]]
        sizes = np.linalg.norm(errors, axis=1)
        moments = moment_intervals(errors, factor, clusters)
        within, between = within_and_between(errors[~solved.is_moving], at_stations)
        components[name] = ComponentStatistics(
            name=name,
            unit=unit,
            bias=moments.bias,
            spread=moments.spread,
            rms=moments.rms,
            median=quantile_interval(sizes, 0.5, clusters),
            p95=quantile_interval(sizes, 0.95, clusters),
            max=max_interval(sizes, clusters),
            within_station=within,
            between_stations=between,
        )
    usual = float(np.median(solved.nees)) / _MEDIAN_NEES
    return AccuracySummary(
        components=components,
        consistency=_consistency(solved, clusters),
        registration_share_m=float(np.sqrt((solved.registration_sigma_m**2).mean())),
        registration_share_rad=float(np.sqrt((solved.registration_sigma_rad**2).mean())),
        range_min_m=float(solved.range_m.min()),
        range_max_m=float(solved.range_m.max()),
        station_count=at_rest,
        capture_count=clusters.captures,
        outlier_count=int((solved.nees > _OUTLIER**2 * _DOF * max(usual, 1e-12)).sum()),
        consistency_by_range=_by_range(solved, rng),
        moving_count=int(solved.is_moving.sum()),
        block_count=clusters.count - at_rest,
    )


def _counted(count: int, thing: str) -> str:
    return f"{count} {thing}{'' if count == 1 else 's'}"


def _by_range(solved: ErrorTable, rng: np.random.Generator) -> tuple[tuple[str, Consistency], ...]:
    # Draws of its own, so that no other interval depends on how many ranges there are.
    own = rng.spawn(1)[0]
    parts = groups(solved, np.full(solved.count, np.nan))
    ranges = [(words, solved.select(mask)) for grouping, words, mask in parts if grouping == "range"]
    return tuple((words, _consistency(part, Clusters.of(part.place, own))) for words, part in ranges)


def _consistency(solved: ErrorTable, clusters: Clusters) -> Consistency:
    total = clusters.sums(solved.nees) / _DOF
    value = float(total.sum()) / clusters.captures
    mean = clusters.unbounded(value)
    if mean is None:
        mean = clusters.estimate(*ratio_interval(total, clusters.size, clusters))
    # Captures of a place share errors, so the band is that of as many samples as there are places.
    freedom = _DOF * clusters.count
    band = [chi2_quantile(q, freedom) / freedom for q in (0.025, 0.975)]
    return Consistency(mean, band[0], band[1], *_honesty(mean, band[0], band[1]))


def _honesty(mean: Estimate, band_low: float, band_high: float) -> tuple[Honesty, str]:
    """Meeting the band is not enough: a wide interval meets every band."""
    if mean.low > band_high or mean.high < band_low:
        word = "too small" if mean.value > 1.0 else "too large"
        return (
            "inconsistent",
            f"stated sigmas are {word}, by a factor of about {max(mean.value, 1.0 / mean.value) ** 0.5:.2g}",
        )
    if not _TRUSTED[0] <= mean.low <= mean.high <= _TRUSTED[1]:
        low, high = max(mean.low, 0.0) ** 0.5, mean.high**0.5
        reach = f"{low:.2g} to {high:.2g}" if np.isfinite(high) else f"{low:.2g} or more"
        return "inconclusive", f"actual sigmas may be {reach} times the stated ones: more places would tell"
    if not band_low <= mean.value <= band_high:
        return "inconclusive", "the interval only just meets the band: more places would tell"
    return "consistent", "stated sigmas are right within a factor of 1.4"
