"""Figures of merit with intervals that respect that captures of one station are not independent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Unit = Literal["m", "rad", "1"]


@dataclass(frozen=True, slots=True)
class Estimate:
    """One figure with its 95 % interval.

    Args:
        value: The figure over the captures at hand, in m, rad or as a plain number; NaN when there is none.
        low: Lower end of the interval; -inf or NaN-free always.
        high: Upper end; inf when the data cannot bound it.
        station_count: Stations behind it.
        capture_count: Captures behind it.
        note: Why the interval is missing or open, empty otherwise.
    """

    value: float
    low: float
    high: float
    station_count: int
    capture_count: int
    note: str = ""

    def scaled(self, factor: float) -> Estimate:
        """The same figure in another unit."""
        return Estimate(
            self.value * factor,
            self.low * factor,
            self.high * factor,
            self.station_count,
            self.capture_count,
            self.note,
        )


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
        is_consistent: Whether the interval meets the band.
    """

    mean_nees_over_6: Estimate
    band_low: float
    band_high: float
    is_consistent: bool


@dataclass(frozen=True, slots=True)
class AccuracySummary:
    """All figures of one set of captures.

    Args:
        components: Statistics by name, in the order of ``ComponentStatistics.name``.
        consistency: The check of the sensor's covariance.
        registration_share_m: Root mean square share of the registration's own doubt in the position errors, m.
        registration_share_rad: The same in the attitude errors, rad.
        range_min_m: Smallest predicted range among the captures with a pose, m.
        range_max_m: Largest, m.
        station_count: Stations with a pose.
        capture_count: Captures with a pose.
        outlier_count: Captures whose error is beyond five times the predicted one; they are included in every figure.
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
