"""Captures that follow one another share errors: how long, what they are worth, and blocks that are independent.

Source: A. Sokal, Monte Carlo methods in statistical mechanics, 3 (window of the autocorrelation time); H. R. Kunsch,
The jackknife and the bootstrap for general stationary observations, 1989 (blocks).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray

# The sum of correlations is cut where the lag exceeds this many times the sum so far.
_WINDOW = 5.0
# Neighbours of an independent series are correlated by less than this over the root of its length, mostly.
_CHANCE = 2.0
# Blocks this many times the integrated autocorrelation time: five correlation times of an exponential decay.
_BLOCK = 2.5


def correlation_time(values: FloatArray, stretch: NDArray[np.int64]) -> float:
    """Integrated autocorrelation time ``1 + 2 sum rho_k`` of a series, in captures.

    Args:
        values: One component in the order of time, shape (n,).
        stretch: Uninterrupted stretch of each capture, shape (n,): correlations are not sought across stretches.

    Returns:
        At least 1; the largest lag that is looked at is a third of the longest stretch.
    """
    centred = values - values.mean()
    power = float(centred @ centred) / max(len(values), 1)
    longest = int(np.unique(stretch, return_counts=True)[1].max()) if len(values) else 0
    if power <= 0.0 or longest < 3:
        return 1.0
    time, count = 1.0, len(values)
    for lag in range(1, longest // 3 + 1):
        same = stretch[lag:] == stretch[:-lag]
        pairs = int(same.sum())
        if pairs == 0:
            break
        # Divided by all captures of the series: pairs at long lags are few and noisy, so they weigh less.
        correlation = float((centred[lag:] * centred[:-lag])[same].sum()) / (count * power)
        if lag == 1 and correlation < _CHANCE / count**0.5:
            return 1.0
        time += 2.0 * correlation
        if lag >= _WINDOW * time:
            break
    # The mean was taken from the same captures, which makes every correlation too low by about time / n.
    return max(time * (1.0 + 2.0 * lag / count), 1.0)


def time_blocks(values: FloatArray, stretch: NDArray[np.int64]) -> tuple[NDArray[np.int64], float]:
    """Blocks of captures long enough to be independent of one another.

    Args:
        values: Errors in the order of time, shape (n, d).
        stretch: Uninterrupted stretch of each capture, shape (n,).

    Returns:
        Block of each capture, shape (n,), and how many independent captures they are worth (the component that stays
        alike longest counts).
    """
    if len(values) == 0:
        return np.empty(0, dtype=np.int64), 0.0
    time = max(correlation_time(column, stretch) for column in values.T)
    length = 1 if time <= 1.0 else int(np.ceil(_BLOCK * time))
    block = np.empty(len(values), dtype=np.int64)
    first = 0
    for name in np.unique(stretch):
        rows = np.flatnonzero(stretch == name)
        # A rest shorter than half a block joins the block before it.
        parts = max(1, round(len(rows) / length))
        block[rows] = first + np.minimum(np.arange(len(rows)) * parts // len(rows), parts - 1)
        first += parts
    return block, len(values) / time


def stretches(t_ns: NDArray[np.int64], session: NDArray[np.int64]) -> NDArray[np.int64]:
    """Uninterrupted stretches: a pause ten times the usual interval, or another run, begins a new one.

    Args:
        t_ns: Instants in ascending order within a run, shape (n,), ns.
        session: Run of each capture, shape (n,).

    Returns:
        Number of the stretch of each capture, shape (n,), from 0.
    """
    if len(t_ns) < 2:
        return np.zeros(len(t_ns), dtype=np.int64)
    step = np.diff(t_ns)
    begins = (step > 10 * max(int(np.median(step)), 1)) | (step < 0) | (np.diff(session) != 0)
    return np.concatenate([[0], np.cumsum(begins)]).astype(np.int64)


def independent_parts(
    place: NDArray[np.int64],
    is_moving: NDArray[np.bool_],
    t_ns: NDArray[np.int64],
    session: NDArray[np.int64],
    values: FloatArray,
) -> NDArray[np.int64]:
    """Parts of a run whose errors do not follow from one another: places at rest, blocks of time in motion.

    Args:
        place: Place of each capture, shape (n,), not negative.
        is_moving: Whether the carriage moved at it, shape (n,).
        t_ns: Its instant, shape (n,), ns.
        session: Its run, shape (n,).
        values: What is correlated, shape (n, d); rows with NaN join the block before them.

    Returns:
        Part of each capture, shape (n,): places as they are, blocks as negative numbers that other runs do not have.
        In motion places are kept where they are fewer than blocks would be.
    """
    out = place.copy()
    order = np.flatnonzero(is_moving)
    order = order[np.lexsort((t_ns[order], session[order]))]
    is_known = np.isfinite(values[order]).all(axis=1)
    known = order[is_known]
    if len(known) == 0:
        return out
    own, _ = time_blocks(values[known], stretches(t_ns[known], session[known]))
    block = own[np.maximum(np.cumsum(is_known) - 1, 0)]
    first = np.unique(block, return_index=True)[1]
    if len(first) < len(np.unique(place[order])):
        out[order] = -1 - t_ns[order[first]][block]
    return out
