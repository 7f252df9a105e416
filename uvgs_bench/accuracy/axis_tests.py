"""How well one axis positions: the self-test of a gantry after ISO 230-2 and ISO 9283, from plain readings.

Source: the formulas of ISO 230-2 (positioning of numerically controlled axes) and ISO 9283 (pose repeatability) as
usually published. The tests follow them; no conformity is claimed, since the instrument is no laser.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uvgs_bench.accuracy.distributions import chi2_quantile, f_quantile
from uvgs_bench.errors import RegistrationError
from uvgs_bench.geometry import FloatArray

# Widths that are tried, as shares of the way to and fro; wider than the last, nothing would move.
_WIDEST_SHARE, _GRID = 0.95, 120


@dataclass(frozen=True, slots=True)
class Positioning:
    """Positioning of one axis, all in m; each repeatability contains the scatter of the instrument.

    Args:
        targets: Number of targets.
        runs: Approaches of each target from each side.
        repeatability_up_m: Largest 4 s of the approaches from below, ``R`` up.
        repeatability_down_m: The same from above.
        repeatability_m: Bidirectional, ``R``.
        reversal_m: Largest difference between the mean positions from both sides, ``B``, with its sign: up minus down.
        mean_reversal_m: Mean of those differences.
        systematic_m: Range of the mean deviations, ``E``.
        mean_systematic_m: Range of the means of both sides, ``M``.
        accuracy_m: Range of mean deviations plus and minus 2 s, ``A``.
        pose_repeatability_m: Largest mean distance from the barycentre plus 3 of its standard deviations, from below,
            as ISO 9283 has it for poses.
        slope: Deviation per travel: a wrong scale of the axis or of the instrument, this test cannot tell which.
    """

    targets: int
    runs: int
    repeatability_up_m: float
    repeatability_down_m: float
    repeatability_m: float
    reversal_m: float
    mean_reversal_m: float
    systematic_m: float
    mean_systematic_m: float
    accuracy_m: float
    pose_repeatability_m: float
    slope: float


def judge_positioning(targets_m: FloatArray, up_m: FloatArray, down_m: FloatArray) -> Positioning:
    """Positioning of one axis from readings at targets approached from both sides.

    The origin of the readings is free: their mean deviation is taken off.

    Args:
        targets_m: Commanded positions, shape (M,), m.
        up_m: Readings when approached from below, shape (M, n), m.
        down_m: Readings when approached from above, shape (M, n), m.

    Returns:
        The figures.

    Raises:
        RegistrationError: Fewer than two targets or two approaches.
    """
    M, n = up_m.shape
    if M < 2 or n < 2 or down_m.shape != up_m.shape:
        raise RegistrationError(f"positioning needs 2 targets and 2 approaches from each side, got {M} and {n}")
    x_up, x_down = up_m - targets_m[:, None], down_m - targets_m[:, None]
    origin = 0.5 * (x_up.mean() + x_down.mean())
    mean_up, mean_down = x_up.mean(axis=1) - origin, x_down.mean(axis=1) - origin
    s_up, s_down = x_up.std(axis=1, ddof=1), x_down.std(axis=1, ddof=1)
    reversal = mean_up - mean_down
    middle = 0.5 * (mean_up + mean_down)
    widest = np.maximum.reduce([2.0 * s_up + 2.0 * s_down + np.abs(reversal), 4.0 * s_up, 4.0 * s_down])
    distance = np.abs(x_up - x_up.mean(axis=1, keepdims=True))
    spread = distance.mean(axis=1) + 3.0 * distance.std(axis=1, ddof=1)
    high = np.maximum(mean_up + 2.0 * s_up, mean_down + 2.0 * s_down)
    low = np.minimum(mean_up - 2.0 * s_up, mean_down - 2.0 * s_down)
    return Positioning(
        targets=M,
        runs=n,
        repeatability_up_m=float(4.0 * s_up.max()),
        repeatability_down_m=float(4.0 * s_down.max()),
        repeatability_m=float(widest.max()),
        reversal_m=float(reversal[np.argmax(np.abs(reversal))]),
        mean_reversal_m=float(reversal.mean()),
        systematic_m=float(np.maximum(mean_up, mean_down).max() - np.minimum(mean_up, mean_down).min()),
        mean_systematic_m=float(middle.max() - middle.min()),
        accuracy_m=float(high.max() - low.min()),
        pose_repeatability_m=float(spread.max()),
        slope=float(np.polyfit(targets_m - targets_m.mean(), middle, 1)[0]),
    )


@dataclass(frozen=True, slots=True)
class DeadBand:
    """How far a motor turns at a reversal before its carriage follows.

    Args:
        width_m: The width, m.
        low_m: Lower end of its 95 % interval, m, not below 0.
        high_m: Upper end, m.
        scatter_m: Standard deviation of the readings about the fit, m.
        reading_count: Number of readings.
    """

    width_m: float
    low_m: float
    high_m: float
    scatter_m: float
    reading_count: int


def played(commands_m: FloatArray, width_m: float) -> FloatArray:
    """Where a carriage with play stands after each of a row of commanded positions.

    Args:
        commands_m: Commanded positions in the order of visits, shape (N,), m; the first was approached from below.
        width_m: Width of the dead band, m.

    Returns:
        Positions, shape (N,), m, up to a constant.
    """
    half = 0.5 * width_m
    out = np.empty(len(commands_m))
    at = commands_m[0] - half
    for i, command in enumerate(commands_m):
        at = min(max(at, command - half), command + half)
        out[i] = at
    return out


def fit_dead_band(commands_m: FloatArray, readings_m: FloatArray) -> DeadBand:
    """Fit the width of the dead band to readings of small steps to and fro.

    Origin and scale of the readings are free. The interval holds every width whose sum of squares is not significantly
    larger than the least.

    Args:
        commands_m: Commanded positions in the order of visits, shape (N,), m; the first was approached from below, and
            the turning points lie further apart than the dead band.
        readings_m: Readings, shape (N,), m.

    Returns:
        The width with its interval.

    Raises:
        RegistrationError: Fewer than 8 readings, or steps that never reverse.
    """
    N = len(commands_m)
    turns = int(np.sum(np.diff(np.sign(np.diff(commands_m))) != 0.0))
    if N < 8 or turns < 1:
        raise RegistrationError(f"a dead band needs 8 readings and a reversal, got {N} and {turns}")
    span = float(np.ptp(commands_m))
    grid = np.linspace(0.0, _WIDEST_SHARE * span, _GRID)
    squares = np.array([_played_square(commands_m, readings_m, width) for width in grid])
    best = int(np.argmin(squares))
    if squares.max() - squares.min() <= 1e-9 * squares.max():
        raise RegistrationError("the steps to and fro say nothing of the dead band")
    low, high = float(grid[max(0, best - 1)]), float(grid[min(_GRID - 1, best + 1)])
    width = _smallest(lambda w: _played_square(commands_m, readings_m, w), low, high)
    least = _played_square(commands_m, readings_m, width)
    # Where the noise is large against the way, the sum of squares is no parabola: what it still allows is looked up.
    allowed = least * (1.0 + f_quantile(0.95, 1, N - 3) / (N - 3)) + 1e-24
    inside = np.flatnonzero(squares <= allowed)
    first, last = (int(inside[0]), int(inside[-1])) if len(inside) else (best, best)

    def edge(within: float, beyond: float) -> float:
        for _ in range(40):
            middle = 0.5 * (within + beyond)
            if _played_square(commands_m, readings_m, middle) <= allowed:
                within = middle
            else:
                beyond = middle
        return within

    low = edge(min(width, float(grid[first])), float(grid[max(0, first - 1)]))
    high = edge(max(width, float(grid[last])), float(grid[min(_GRID - 1, last + 1)]))
    return DeadBand(width, low, high, float(np.sqrt(least / (N - 3))), N)


def _smallest(square: Callable[[float], float], low: float, high: float) -> float:
    """Golden-section search."""
    ratio = 0.5 * (float(np.sqrt(5.0)) - 1.0)
    a, b = high - ratio * (high - low), low + ratio * (high - low)
    at_a, at_b = square(a), square(b)
    for _ in range(50):
        if at_a <= at_b:
            high, b, at_b = b, a, at_a
            a = high - ratio * (high - low)
            at_a = square(a)
        else:
            low, a, at_a = a, b, at_b
            b = low + ratio * (high - low)
            at_b = square(b)
    return 0.5 * (low + high)


def _played_square(commands_m: FloatArray, readings_m: FloatArray, width_m: float) -> float:
    """Sum of squared residuals once origin and scale fit best."""
    x = played(commands_m, width_m)
    x, y = x - x.mean(), readings_m - readings_m.mean()
    xx = float(x @ x)
    residual = y - (float(x @ y) / xx * x if xx > 0.0 else 0.0)
    return float(residual @ residual)


@dataclass(frozen=True, slots=True)
class Drift:
    """How a place that is visited again and again wanders.

    Args:
        rate_mps: Slope of the readings over time, m/s.
        sigma_mps: Its standard deviation, m/s.
        range_m: Largest less smallest reading, m.
        duration_s: From the first to the last visit, s.
        visit_count: Number of visits.
    """

    rate_mps: float
    sigma_mps: float
    range_m: float
    duration_s: float
    visit_count: int


def fit_drift(t_s: FloatArray, readings_m: FloatArray) -> Drift:
    """Fit a straight line to the readings of one place over time.

    Args:
        t_s: Instants, shape (N,), s.
        readings_m: Readings along one axis, shape (N,), m.

    Returns:
        The drift.

    Raises:
        RegistrationError: Fewer than three visits, or all at one instant.
    """
    N = len(t_s)
    since = t_s - t_s.mean()
    square = float(since @ since)
    if N < 3 or square == 0.0:
        raise RegistrationError(f"drift needs three visits at different times, got {N}")
    rate = float(since @ readings_m) / square
    residual = readings_m - readings_m.mean() - rate * since
    sigma = float(np.sqrt(residual @ residual / (N - 2) / square))
    return Drift(rate, sigma, float(np.ptp(readings_m)), float(np.ptp(t_s)), N)


@dataclass(frozen=True, slots=True)
class Scatter:
    """Standard deviation of repeated readings of one thing, with its 95 % interval.

    Args:
        sigma_m: The standard deviation, m.
        low_m: Lower end, m.
        high_m: Upper end, m.
        count: Number of readings.
    """

    sigma_m: float
    low_m: float
    high_m: float
    count: int


def scatter_of(readings_m: FloatArray) -> Scatter:
    """Standard deviation of readings with the interval of a normal variance.

    Args:
        readings_m: Readings, shape (N,), m.

    Returns:
        The scatter.

    Raises:
        RegistrationError: Fewer than two readings.
    """
    N = len(readings_m)
    if N < 2:
        raise RegistrationError(f"a scatter needs two readings, got {N}")
    sigma = float(np.std(readings_m, ddof=1))
    low, high = (sigma * float(np.sqrt((N - 1) / chi2_quantile(q, N - 1))) for q in (0.975, 0.025))
    return Scatter(sigma, low, high, N)
