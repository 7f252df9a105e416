"""From estimates in SI to what a page shows: unit, digits, words."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from uvgs_bench.accuracy.judgement import QUANTITIES, LimitVerdict
from uvgs_bench.accuracy.statistics import Estimate
from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.cells import Interval, Measured, Number, decimals_for
from uvgs_bench.store.run import Run
from uvgs_bench.units import deg_from_rad, mm_from_m, ms_from_s

COMPONENT_WORDS = {
    "lateral_x": "lateral x (right)",
    "lateral_y": "lateral y (down)",
    "depth": "depth z (forward)",
    "lateral": "lateral, both axes",
    "position": "position, all axes",
    "tilt_x": "tilt about x",
    "tilt_y": "tilt about y",
    "roll": "roll about z",
    "attitude": "attitude, all axes",
}
STATISTIC_WORDS = {
    "bias": "bias",
    "spread": "spread",
    "rms": "RMS",
    "median": "median",
    "p95": "95th percentile",
    "max": "largest",
    "fraction": "share of captures with a pose",
}

LARGEST_WORDS = "95 % of all lie below it with 95 % confidence"
"""What the largest of enough values says about those not taken."""

CAMERA_CONVENTIONS = (
    ("Camera frame", "Optical centre; x right, y down, z forward."),
    ("Transforms", "target_from_source maps points of the source into the target: p_c = camera_from_beacon p_b."),
    ("Pixels", "(0, 0) is the centre of the top-left pixel; residual = observed − projected."),
)
"""What every report about a camera must say."""


@dataclass(frozen=True, slots=True)
class Scale:
    """How a quantity is shown.

    Args:
        unit: Unit as printed.
        factor: From SI to that unit.
    """

    unit: str
    factor: float


SCALES = {
    "m": Scale("mm", mm_from_m(1.0)),
    "rad": Scale("deg", deg_from_rad(1.0)),
    "s": Scale("ms", ms_from_s(1.0)),
    "1": Scale("", 1.0),
    "percent": Scale("%", 100.0),
}
"""Unit of an estimate (or ``percent`` for a fraction) to how it is shown."""


def unit_word(unit: str) -> str:
    """A unit as printed."""
    return "%" if unit == "percent" else unit


def decimals_of(estimates: Iterable[Estimate], factor: float, default: int = 3) -> int:
    """Digits after the point common to several estimates, from the doubt of the typical one.

    Args:
        estimates: In SI.
        factor: From SI to the unit shown.
        default: When no estimate has a finite interval.

    Returns:
        Digits after the point.
    """
    known = list(estimates)
    widths = [0.5 * factor * (e.high - e.low) for e in known]
    if any(np.isfinite(w) and w > 0.0 for w in widths):
        return decimals_for(widths, default=default)
    # Without any interval, three significant digits of the figure itself are all that can be defended.
    return decimals_for([0.1 * factor * abs(e.value) for e in known], default=default)


def measured(estimate: Estimate, scale: Scale, decimals: int) -> Measured:
    """A figure and its interval, for a table cell."""
    e = estimate.scaled(scale.factor)
    return Measured(Number(e.value, decimals, scale.unit), Interval(e.low, e.high, decimals, scale.unit))


def stations_taken(run: Run) -> int:
    """Planned stations with a capture; captures along a motion have numbers after theirs and do not count."""
    planned = run.manifest.station_count
    return len({sample.station for sample in run.samples if not planned or sample.station < planned})


def is_largest_seen(verdict: LimitVerdict) -> bool:
    """Whether a limit was held against the largest value seen, which is a fact and has no interval."""
    return QUANTITIES[verdict.limit.quantity][1].endswith("max") and verdict.low == verdict.value == verdict.high


def limit_reason(verdict: LimitVerdict) -> str:
    """Why a limit is met or not, in words."""
    if not is_largest_seen(verdict):
        return verdict.reason
    if verdict.verdict == "pass":
        return f"the largest seen is within the limit, and {LARGEST_WORDS}"
    return "the largest seen is beyond the limit"


def station_means(station: np.ndarray[tuple[int, ...], np.dtype[np.int64]], values: FloatArray) -> FloatArray:
    """Mean of the finite rows of each station, in the order of station numbers.

    Args:
        station: Station of each row, shape (N,).
        values: Values, shape (N, k).

    Returns:
        Means, shape (S, k); NaN for a station without a finite row.
    """
    numbers, place = np.unique(station, return_inverse=True)
    is_finite = np.isfinite(values).all(axis=1)
    count = np.bincount(place[is_finite], minlength=len(numbers)).astype(np.float64)
    total = np.stack(
        [np.bincount(place[is_finite], weights=column[is_finite], minlength=len(numbers)) for column in values.T],
        axis=1,
    )
    means: FloatArray = np.where(count[:, None] > 0.0, total / np.maximum(count, 1.0)[:, None], np.nan)
    return means
