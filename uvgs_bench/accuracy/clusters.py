"""Captures grouped by place: what shares an error is drawn together, and counted for what it is worth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray

LEAST_PLACES = 8
"""With fewer places the spread between places is known too badly for any interval."""
TAIL = 0.025
"""Probability left out at each end of an interval."""
_RESAMPLES = 2000
_PIECE = 100
_PARAMETERS = 12


@dataclass(frozen=True, slots=True)
class Estimate:
    """One figure with its 95 % interval.

    Args:
        value: The figure over the captures at hand, in m, rad or as a plain number; NaN when there is none.
        low: Lower end of the interval, never NaN; -inf when the data cannot bound it.
        high: Upper end; inf when the data cannot bound it.
        station_count: Places behind it (stations that revisit a place count once).
        capture_count: Captures behind it.
        note: Why the interval is missing or open, empty otherwise.
        effective_count: How many independent captures they are worth; 0 when that was not computed.
    """

    value: float
    low: float
    high: float
    station_count: int
    capture_count: int
    note: str = ""
    effective_count: float = 0.0

    def scaled(self, factor: float) -> Estimate:
        """The same figure in another unit."""
        ends = self.value * factor, self.low * factor, self.high * factor
        return Estimate(*ends, self.station_count, self.capture_count, self.note, self.effective_count)


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """Which captures share a place, with the places drawn again and again.

    Args:
        index: Place of each capture as a running number, shape (n,).
        size: Captures per place, shape (S,).
        draws: How often each place is drawn in each resample, shape (B, S).
        shifts: One standard normal draw of the registration's doubt per resample, shape (B, 12).
    """

    index: NDArray[np.intp]
    size: FloatArray
    draws: FloatArray
    shifts: FloatArray

    @classmethod
    def of(cls, place: NDArray[np.int64], rng: np.random.Generator) -> Clusters:
        """Group captures by place and draw the resamples.

        Args:
            place: Place of each capture, shape (n,).
            rng: Source of randomness.

        Returns:
            The clusters.
        """
        counted = cls.counted(place)
        S = counted.count
        return cls(counted.index, counted.size, _drawn(S, rng), rng.normal(size=(_RESAMPLES, _PARAMETERS)))

    @classmethod
    def counted(cls, place: NDArray[np.int64]) -> Clusters:
        """Group captures by place without drawing: enough for intervals by order and for fractions.

        Args:
            place: Place of each capture, shape (n,).

        Returns:
            The clusters, with no resamples.
        """
        names, index = np.unique(place, return_inverse=True)
        S = len(names)
        size = np.bincount(index, minlength=S).astype(np.float64)
        return cls(index, size, np.empty((0, S)), np.empty((0, _PARAMETERS)))

    @property
    def count(self) -> int:
        """Number of places."""
        return len(self.size)

    @property
    def captures(self) -> int:
        """Number of captures."""
        return len(self.index)

    def sums(self, values: FloatArray) -> FloatArray:
        """Sums per place, shape (S, ...) of values (n, ...)."""
        out = np.zeros((self.count, *values.shape[1:]))
        np.add.at(out, self.index, values)
        return out

    def estimate(self, value: float, low: float, high: float, note: str = "", worth: float = 0.0) -> Estimate:
        """An estimate that carries these counts."""
        return Estimate(float(value), float(low), float(high), self.count, self.captures, note, float(worth))

    def unbounded(self, value: float, floor: float = 0.0) -> Estimate | None:
        """The estimate to give when there are too few places for an interval, or None when there are enough."""
        if self.count >= LEAST_PLACES:
            return None
        plural = "" if self.count == 1 else "s"
        note = f"only {self.count} station{plural}, at least {LEAST_PLACES} are needed for an interval"
        return self.estimate(value, floor, np.inf, note)


def _drawn(S: int, rng: np.random.Generator) -> FloatArray:
    """How often each of S places is drawn when S are, shape (B, S).

    Places are drawn one by one and counted: a tenth of the time of drawing the counts.
    """
    draws = np.empty((_RESAMPLES, S))
    # In pieces that stay in the cache.
    first_of = (S * np.arange(_PIECE))[:, None]
    for start in range(0, _RESAMPLES if S else 0, _PIECE):
        places = rng.integers(S, size=(_PIECE, S)) + first_of
        draws[start : start + _PIECE] = np.bincount(places.ravel(), minlength=_PIECE * S).reshape(_PIECE, S)
    return draws


def mean_squares(errors: FloatArray, clusters: Clusters) -> tuple[float, float, float]:
    """One-way analysis of variance by place, summed over components.

    Args:
        errors: Errors, shape (n, d); more captures than places, at least two places.
        clusters: Their places.

    Returns:
        Mean square within places, mean square between places, effective captures per place.
    """
    n, S = clusters.captures, clusters.count
    means = clusters.sums(errors) / clusters.size[:, None]
    within = float(((errors - means[clusters.index]) ** 2).sum()) / (n - S)
    between = float((clusters.size[:, None] * (means - errors.mean(axis=0)) ** 2).sum()) / (S - 1)
    size = (n - float((clusters.size**2).sum()) / n) / (S - 1)
    return within, between, size


def worth(values: FloatArray, clusters: Clusters) -> float:
    """How many independent captures the captures are worth, by the intraclass correlation of a quantity.

    Args:
        values: The quantity, shape (n,), or vectors, shape (n, d).
        clusters: Its places.

    Returns:
        Between the number of places and the number of captures.
    """
    n, S = clusters.captures, clusters.count
    if n == S or S < 2:
        return float(S)
    within, between, size = mean_squares(values.reshape(n, -1), clusters)
    if within + between <= 0.0:
        return float(S)
    correlation = min(max((between - within) / (between + (size - 1.0) * within), 0.0), 1.0)
    return float(np.clip(n / (1.0 + (size - 1.0) * correlation), S, n))
