"""Intervals of quantiles, the largest value and fractions, without assuming a law.

The number of captures is first reduced to what they are worth (intraclass correlation). With too few of them the upper
end is infinite, and the note says how many are needed.

Source: G. Hahn and W. Meeker, Statistical Intervals, chapter 5; C. Clopper and E. Pearson, 1934.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.clusters import TAIL, Clusters, Estimate, worth
from uvgs_bench.accuracy.distributions import beta_quantile, binomial_cdf, binomial_quantile
from uvgs_bench.geometry import FloatArray

# log(0.05) / log(0.95), rounded up.
_LEAST_FOR_MAX = 59


def quantile_interval(sizes: FloatArray, level: float, clusters: Clusters) -> Estimate:
    """A quantile of absolute values with its order-statistic interval.

    Args:
        sizes: Absolute values, shape (n,), n >= 1.
        level: Between 0 and 1.
        clusters: Their places.

    Returns:
        The estimate; its upper end is infinite when even the largest value need not reach the quantile.
    """
    ordered = np.sort(sizes)
    value = float(np.quantile(ordered, level))
    trials = int(worth(sizes, clusters))
    lower = binomial_quantile(TAIL, trials, level)
    upper = binomial_quantile(1.0 - TAIL, trials, level) + 1
    # Seen from above, a lower end is the upper end of the complement.
    low = -_interpolated(-ordered[::-1], trials, 1.0 - level, trials + 1 - lower) if lower >= 1 else 0.0
    if upper > trials:
        needed = int(np.ceil(np.log(TAIL) / np.log(level)))
        note = f"worth {trials} independent captures: {needed} are needed to bound the {100.0 * level:.0f}th percentile"
        return clusters.estimate(value, min(low, value), np.inf, note, trials)
    high = _interpolated(ordered, trials, level, upper)
    return clusters.estimate(value, min(low, value), max(high, value), worth=trials)


def _interpolated(ordered: FloatArray, trials: int, level: float, rank: int) -> float:
    """Upper end between two order statistics, where the one of ``rank`` alone would cover more than is asked.

    Source: J. Nyblom, Note on interpolated order statistics, 1992.
    """
    wanted = 1.0 - TAIL
    less, more = (binomial_cdf(r - 1, trials, level) for r in (rank - 1, rank))
    share = 1.0
    if rank > 1 and less < wanted < more and rank <= trials:
        odds = (rank - 1) * (1.0 - level) * (more - wanted) / ((trials - rank + 1) * level * (wanted - less))
        share = 1.0 / (1.0 + odds)
    n = len(ordered)
    # Captures of one place that are worth one lie side by side: the middle of them stands for their rank.
    below, above = np.interp((np.array([rank - 1, rank]) - 0.5) / trials, (np.arange(n) + 0.5) / n, ordered)
    return float((1.0 - share) * below + share * above)


def max_interval(sizes: FloatArray, clusters: Clusters, things: str = "independent captures") -> Estimate:
    """The largest value, with what it says about values not taken.

    Args:
        sizes: Absolute values, shape (n,), n >= 1.
        clusters: Their places.
        things: What is counted, in words.

    Returns:
        The estimate: bounded by the largest value itself when 95 % of all values lie below it with 95 % confidence
        (59 independent captures), else open above.
    """
    value = float(sizes.max())
    trials = int(worth(sizes, clusters))
    if trials >= _LEAST_FOR_MAX:
        return clusters.estimate(value, value, value, worth=trials)
    covered = 100.0 * (2.0 * TAIL) ** (1.0 / trials)
    note = (
        f"worth {trials} {things}: {covered:.0f} % of all lie below it with 95 % confidence, "
        f"{_LEAST_FOR_MAX} are needed for 95 %"
    )
    return clusters.estimate(value, value, np.inf, note, trials)


def tolerance_bound(sizes: FloatArray, level: float, clusters: Clusters) -> Estimate:
    """The value below which a part of all captures lies with 95 % confidence, every place counted as one.

    Args:
        sizes: Absolute values, shape (n,), n >= 1.
        level: The part, between 0 and 1.
        clusters: Their places.

    Returns:
        Value and upper end: the bound; lower end: what the quantile exceeds with 95 % confidence. With too few places
        the value is the largest seen and the upper end infinite.
    """
    n, trials = len(sizes), clusters.count
    ordered = np.sort(sizes)
    upper = binomial_quantile(1.0 - 2.0 * TAIL, trials, level) + 1
    lower = binomial_quantile(2.0 * TAIL, trials, level)
    low = float(ordered[int(np.floor((lower - 1) / trials * n))]) if lower >= 1 else 0.0
    if upper > trials:
        needed = int(np.ceil(np.log(2.0 * TAIL) / np.log(level)))
        note = f"{trials} places: {needed} are needed to bound {100.0 * level:.0f} % of captures with 95 % confidence"
        return clusters.estimate(float(ordered[-1]), low, np.inf, note, trials)
    bound = float(ordered[int(np.ceil(upper / trials * n)) - 1])
    return clusters.estimate(bound, low, bound, worth=trials)


def fraction_interval(successes: NDArray[np.bool_], clusters: Clusters) -> Estimate:
    """A fraction with its exact interval (Clopper-Pearson) for as many trials as the captures are worth.

    Args:
        successes: One flag per capture, shape (n,), n >= 1.
        clusters: Their places.

    Returns:
        The estimate.
    """
    value = float(successes.mean())
    # Without a single failure (or success) nothing is known about how they cluster: a place is then one trial.
    trials = float(clusters.count) if value in (0.0, 1.0) else worth(successes.astype(np.float64), clusters)
    k = value * trials
    low = beta_quantile(TAIL, k, trials - k + 1.0) if k > 0.0 else 0.0
    high = beta_quantile(1.0 - TAIL, k + 1.0, trials - k) if k < trials else 1.0
    return clusters.estimate(value, low, high, worth=trials)
