"""Intervals of means, mean squares and variances of clustered errors.

Captures of one place share errors, so places are drawn, never captures. The intervals are studentized cluster bootstrap
intervals, on the logarithm for squares: they keep their promise with 20 places where percentile intervals do not.

Source: B. Efron and R. Tibshirani, An Introduction to the Bootstrap, chapters 12 and 14; A. C. Davison and
D. V. Hinkley, Bootstrap Methods, 3.8; J. Williams, A confidence interval for variance components, 1962.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.accuracy.clusters import TAIL, Clusters, Estimate, mean_squares, worth
from uvgs_bench.accuracy.distributions import chi2_quantile, f_quantile, normal_quantile, t_quantile
from uvgs_bench.geometry import FloatArray

# Of a normal distribution, leaving ``TAIL`` at each end.
_NORMAL = 1.959964


@dataclass(frozen=True, slots=True)
class MomentIntervals:
    """Bias, spread and root mean square of one error vector."""

    bias: Estimate
    spread: Estimate
    rms: Estimate


def moment_intervals(errors: FloatArray, factor: FloatArray, clusters: Clusters) -> MomentIntervals:
    """Bias, spread and RMS of an error vector of d components, with the registration's doubt in their intervals.

    A registration error shifts all errors together, which no drawing of places shows: its effect on each figure is
    added to the variance, and its expected share of the mean square is taken off both ends. The upper end stays at the
    figure or above.

    Args:
        errors: Errors of captures with a pose, shape (n, d), d >= 1.
        factor: Effect of the registration's doubt on them, shape (n, d, 12).
        clusters: Their places.

    Returns:
        The three estimates. For d = 1 bias is signed; else it is the length of the mean vector.
    """
    n, d = errors.shape
    mean = errors.mean(axis=0)
    square = float((errors**2).sum(axis=1).mean())
    variance = max(square - float(mean @ mean), 0.0)
    centred = errors - mean
    shared_mean = factor.mean(axis=0)
    shared_square = float((factor**2).sum()) / n
    shared_variance = max(shared_square - float((shared_mean**2).sum()), 0.0)
    bias_value = float(mean[0]) if d == 1 else float(np.linalg.norm(mean))
    open_bias = clusters.unbounded(bias_value, -np.inf if d == 1 else 0.0)
    open_spread, open_rms = clusters.unbounded(np.sqrt(variance)), clusters.unbounded(np.sqrt(square))
    if open_bias and open_spread and open_rms:
        return MomentIntervals(open_bias, open_spread, open_rms)

    S = clusters.count
    totals = np.column_stack(
        [clusters.sums((errors**2).sum(axis=1)), clusters.sums(errors), clusters.size]
    )  # squares, components, captures of each place
    drawn = _Drawn.of(totals, clusters)
    ones = np.ones(len(drawn.first))
    m = drawn.first[:, 1:-1] / drawn.first[:, -1:]
    m2 = drawn.first[:, 0] / drawn.first[:, -1]
    v = np.maximum(m2 - (m**2).sum(axis=1), 1e-300)

    # Influence of a place on each figure is linear in its totals: coefficients here, for the data and each resample.
    ms_here = np.concatenate([[1.0], np.zeros(d), [-square]])
    ms_drawn = np.column_stack([ones, np.zeros((len(ones), d)), -m2])
    var_here = np.concatenate([[1.0], -2.0 * mean, [2.0 * float(mean @ mean) - square]])
    var_drawn = np.column_stack([ones, -2.0 * m, 2.0 * (m**2).sum(axis=1) - m2])

    # The share itself is a square of what is not known: its standard deviation beside that of the cross term.
    Q = np.einsum("ndi,ndj->ij", factor, factor) / n
    Q_centred = Q - shared_mean.T @ shared_mean
    shared_ms = _length(2.0 * np.einsum("nd,ndk->k", errors, factor) / n, 2.0**0.5 * Q)
    shared_var = _length(2.0 * np.einsum("nd,ndk->k", centred, factor) / n, 2.0**0.5 * Q_centred)
    low, high = _log_interval(square, drawn.sigma_here(ms_here), m2, drawn.sigmas(ms_drawn), shared_ms)
    counted = worth(errors, clusters)
    ends = np.sqrt(max(low - shared_square, 0.0)), np.sqrt(max(high - shared_square, square))
    rms = clusters.estimate(np.sqrt(square), *ends, worth=counted)
    low, high = _log_interval(variance, drawn.sigma_here(var_here), v, drawn.sigmas(var_drawn), shared_var)
    # The mean follows the places at hand: the population form is too small by the variance of the mean.
    mean_variance = sum(
        drawn.sigma_here(np.concatenate([[0.0], axis, [-float(axis @ mean)]])) ** 2 for axis in np.eye(d)
    )
    grown = 1.0 + mean_variance / max(variance, 1e-300)
    low, high = low * grown, high * grown
    ends = np.sqrt(max(low - shared_variance, 0.0)), np.sqrt(max(high - shared_variance, variance))
    spread = clusters.estimate(np.sqrt(variance), *ends, worth=counted)
    if d == 1:
        sigma = drawn.sigma_here(np.array([0.0, 1.0, -mean[0]]))
        each = drawn.sigmas(np.column_stack([0.0 * ones, ones, -m[:, 0]]))
        q_low, q_high = _studentized((m[:, 0] - mean[0]), each)
        total = float(np.hypot(sigma, np.linalg.norm(shared_mean)))
        ends = bias_value - q_high * total, bias_value - q_low * total
        bias = clusters.estimate(bias_value, *ends, worth=counted)
    else:
        shared = clusters.shifts[:, :d] @ np.linalg.qr(shared_mean.T, mode="r")
        radius = _mean_radius(m - mean, shared, S)
        bias = clusters.estimate(bias_value, max(bias_value - radius, 0.0), bias_value + radius, worth=counted)
    return MomentIntervals(bias, spread, rms)


def _length(*parts: FloatArray) -> float:
    """Root of the sum of squares of independent parts."""
    return float(np.sqrt(sum(float((part**2).sum()) for part in parts)))


def ratio_interval(numerator: FloatArray, denominator: FloatArray, clusters: Clusters) -> tuple[float, float, float]:
    """A positive ratio of sums over places, with its interval on the logarithm.

    Args:
        numerator: Sums per place, shape (S,), not negative.
        denominator: Sums per place, shape (S,), not negative.
        clusters: The places; at least ``LEAST_PLACES``.

    Returns:
        Ratio, low, high.
    """
    totals = np.column_stack([numerator, denominator])
    drawn = _Drawn.of(totals, clusters)
    value = float(numerator.sum() / denominator.sum())
    each = drawn.first[:, 0] / np.maximum(drawn.first[:, 1], 1e-300)
    sigma = drawn.sigma_here(np.array([1.0, -value]))
    low, high = _log_interval(value, sigma, each, drawn.sigmas(np.column_stack([np.ones(len(each)), -each])), 0.0)
    return value, low, high


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    """First and second moments of the totals of places, for the data and for every resample; the last total divides."""

    first: FloatArray
    second: FloatArray
    first_here: FloatArray
    second_here: FloatArray
    inflation: float

    @classmethod
    def of(cls, totals: FloatArray, clusters: Clusters) -> _Drawn:
        S, p = totals.shape
        products = (totals[:, :, None] * totals[:, None, :]).reshape(S, p * p)
        return cls(
            clusters.draws @ totals,
            (clusters.draws @ products).reshape(-1, p, p),
            totals.sum(axis=0),
            products.sum(axis=0).reshape(p, p),
            S / (S - 1.0),
        )

    def sigma_here(self, coefficients: FloatArray) -> float:
        """Standard deviation of a figure whose influence is ``coefficients @ totals``."""
        square = float(coefficients @ self.second_here @ coefficients)
        return float(np.sqrt(max(self.inflation * square, 0.0)) / self.first_here[-1])

    def sigmas(self, coefficients: FloatArray) -> FloatArray:
        """The same for every resample, shape (B,)."""
        square = np.einsum("bi,bij,bj->b", coefficients, self.second, coefficients)
        out: FloatArray = np.sqrt(np.maximum(self.inflation * square, 0.0)) / np.maximum(self.first[:, -1], 1e-300)
        return out


def _studentized(deviation: FloatArray, sigma: FloatArray) -> tuple[float, float]:
    """Quantiles of deviation over its own standard deviation, over the resamples that have one."""
    is_usable = sigma > 1e-9 * float(np.median(sigma))
    if not is_usable.any():
        return 0.0, 0.0
    t = deviation[is_usable] / sigma[is_usable]
    low, high = np.quantile(t, [TAIL, 1.0 - TAIL])
    return float(low), float(high)


def _log_interval(
    value: float, sigma: float, drawn: FloatArray, drawn_sigma: FloatArray, shared: float
) -> tuple[float, float]:
    """Studentized interval of a positive figure on the logarithm; ``shared`` is a further standard deviation.

    The logarithm suits what scatters in proportion to the figure. What is shared does not, so it widens the ends by
    itself: a doubt larger than the figure must not grow without bounds.
    """
    if not value > 0.0:
        return 0.0, 0.0
    safe = np.maximum(drawn, 1e-300)
    q_low, q_high = _studentized(np.log(safe / value), drawn_sigma / safe)
    own = sigma / value
    low, high = float(value * np.exp(-q_high * own)), float(value * np.exp(min(-q_low * own, 50.0)))
    reach = _NORMAL * shared
    return value - float(np.hypot(value - low, reach)), value + float(np.hypot(high - value, reach))


def _mean_radius(deviations: FloatArray, shared: FloatArray, S: int) -> float:
    """Radius around the mean vector that holds the true one with 95 %: its length can be off by no more."""
    small = np.sqrt(S / (S - 1.0)) * t_quantile(1.0 - TAIL, S - 1) / normal_quantile(1.0 - TAIL)
    return float(np.quantile(np.linalg.norm(small * deviations + shared, axis=1), 1.0 - 2.0 * TAIL))


def within_and_between(errors: FloatArray, clusters: Clusters) -> tuple[Estimate, Estimate]:
    """Standard deviation within places (repeatability) and of the effects of places.

    Args:
        errors: Errors, shape (n, d).
        clusters: Their places.

    Returns:
        Within, between; without a figure when every place has one capture.
    """
    n, S = clusters.captures, clusters.count
    if S < 2 or n == S:
        nothing = clusters.estimate(np.nan, 0.0, np.inf, "needs stations with more than one capture")
        return nothing, nothing
    within, between, size = mean_squares(errors, clusters)
    effect = np.sqrt(max((between - within) / size, 0.0))
    open_within, open_between = clusters.unbounded(np.sqrt(within)), clusters.unbounded(effect)
    if open_within and open_between:
        return open_within, open_between
    means = clusters.sums(errors) / clusters.size[:, None]
    inside = clusters.sums(((errors - means[clusters.index]) ** 2).sum(axis=1))
    _, low, high = ratio_interval(inside, clusters.size - 1.0, clusters)
    repeatability = clusters.estimate(np.sqrt(within), np.sqrt(low), np.sqrt(high))
    if within <= 0.0:
        return repeatability, clusters.estimate(effect, effect, effect)
    ratio = between / within
    df = directions(means) * (S - 1), directions(errors - means[clusters.index]) * (n - S)
    ends = [
        between * df[0] / (size * chi2_quantile(q, df[0])) * (1.0 - f_quantile(q, *df) / ratio)
        for q in (1.0 - TAIL, TAIL)
    ]
    ends = [float(np.sqrt(max(end, 0.0))) for end in ends]
    return repeatability, clusters.estimate(effect, min(ends[0], effect), max(ends[1], effect))


def directions(values: FloatArray) -> float:
    """How many equally strong directions the scatter of vectors has, 1 to d (Satterthwaite).

    Args:
        values: Vectors, shape (n, d), n >= 2.

    Returns:
        Between 1 and d.
    """
    V = np.atleast_2d(np.cov(values.T))
    return float(np.trace(V) ** 2 / max(float((V**2).sum()), 1e-300)) if np.trace(V) > 0.0 else 1.0
