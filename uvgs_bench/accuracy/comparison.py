"""Whether one run is worse than another: every figure's change with its interval, and what could not have been seen.

Places are compared with themselves where both runs visited the same plan, so that what a place does to both cancels;
otherwise the runs are independent. Captures of one place count once. The registration of each run adds its own doubt.

Source: B. Efron and R. Tibshirani, An Introduction to the Bootstrap, chapters 11 and 22 (influence of a place on a
figure); S. Holm, A simple sequentially rejective multiple test procedure, 1979.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from uvgs_bench.accuracy.clusters import LEAST_PLACES
from uvgs_bench.accuracy.distributions import t_quantile, t_tail
from uvgs_bench.accuracy.pose_error import ErrorTable
from uvgs_bench.geometry import FloatArray

Word = Literal["worse", "better", "no difference shown", "inconclusive"]
Unit = Literal["m", "rad", "percent"]

LEVEL = 0.05
"""Chance of calling any unchanged figure changed, over all figures and runs of one comparison."""
_RESAMPLES = 2000
_TAIL = 0.025
_P95 = 0.95


@dataclass(frozen=True, slots=True)
class Change:
    """One figure of two runs.

    Args:
        key: The figure, like ``position_rms``.
        unit: ``m`` or ``rad``, compared as a ratio; ``percent`` is a fraction, 0 to 1, compared as a difference.
        first: The figure of the baseline.
        second: The figure of the other run.
        change: ``second / first``, or ``second - first`` for a fraction; NaN when there is none.
        low: Lower end of the 95 % interval of the change.
        high: Upper end.
        p_value: Two-sided, alone; NaN when there is no interval.
        adjusted_p: The same after Holm, over every figure of the comparison.
        seen: The smallest change that would have been shown with these data, as ratio (over 1) or difference.
        places: Places behind it, of the run that has fewer.
        is_paired: Whether places were compared with themselves.
        word: The verdict.
        note: Why there is none, or empty.
    """

    key: str
    unit: Unit
    first: float
    second: float
    change: float
    low: float
    high: float
    p_value: float
    adjusted_p: float
    seen: float
    places: int
    is_paired: bool
    word: Word
    note: str = ""


def compare_tables(
    first: ErrorTable, second: ErrorTable, rng: np.random.Generator, *, is_paired: bool
) -> tuple[Change, ...]:
    """Compare the figures of two runs.

    Args:
        first: Errors of the baseline, misses included.
        second: Errors of the other run.
        rng: Source of randomness for the percentiles.
        is_paired: Whether the same number of a place means the same place in both.

    Returns:
        The changes, not yet judged: ``word`` says only ``inconclusive`` or ``no difference shown``.
    """
    changes: list[Change] = []
    for name, unit in _COMPONENTS.items():
        a, b = _part(first, name), _part(second, name)
        changes.append(_moments(f"{name}_rms", unit, a, b, is_paired))
    for name in ("position", "attitude"):
        a, b = _part(first, name), _part(second, name)
        changes.append(_percentile(f"{name}_p95", _COMPONENTS[name], a, b, is_paired, rng))
        a, b = a.about_places(), b.about_places()
        changes.append(_moments(f"{name}_repeatability", _COMPONENTS[name], a, b, is_paired))
    changes.append(_availability(first, second, is_paired))
    return tuple(changes)


def judged(comparisons: Sequence[Sequence[Change]], *, allowed: float = 0.0) -> tuple[tuple[Change, ...], ...]:
    """Say of every change what it is, with the chance of a false word held over all of them together.

    Args:
        comparisons: The changes of each run against its baseline.
        allowed: Worsening that is tolerated: 0.1 means by a tenth, or 0.1 of the captures.

    Returns:
        The same changes with ``adjusted_p`` and ``word``.
    """
    every = [change.p_value for changes in comparisons for change in changes]
    adjusted = iter(_holm(every))
    return tuple(tuple(_named(change, next(adjusted), allowed) for change in changes) for changes in comparisons)


# --- one figure ------------------------------------------------------------------------------------------------------

_COMPONENTS: dict[str, Literal["m", "rad"]] = {"position": "m", "lateral": "m", "depth": "m", "attitude": "rad"}
_AXES = {"position": (0, 1, 2), "lateral": (0, 1), "depth": (2,), "attitude": (0, 1, 2)}


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Errors of the solved captures of a run: places, error vectors, weight in captures, registration's effect."""

    place: FloatArray
    errors: FloatArray
    weight: FloatArray
    factor: FloatArray

    def about_places(self) -> _Part:
        """Errors about the mean of their place; a place with one capture says nothing."""
        names, index = np.unique(self.place, return_inverse=True)
        count = np.bincount(index).astype(np.float64)
        means = np.zeros((len(names), self.errors.shape[1]))
        np.add.at(means, index, self.errors)
        rest = self.errors - (means / count[:, None])[index]
        kept = count[index] > 1.0
        weight = ((count - 1.0) / count)[index]
        return _Part(self.place[kept], rest[kept], weight[kept], np.zeros((int(kept.sum()), rest.shape[1], 1)))

    @property
    def square(self) -> float:
        """Mean square."""
        return float((self.errors**2).sum()) / float(self.weight.sum())

    def influence(self) -> dict[float, float]:
        """Of every place on the logarithm of the root mean square."""
        names, index = np.unique(self.place, return_inverse=True)
        squares = np.bincount(index, weights=(self.errors**2).sum(axis=1))
        counts = np.bincount(index, weights=self.weight)
        mean = self.square
        effect = (squares - mean * counts) / (2.0 * mean * counts.sum())
        return dict(zip(names.tolist(), effect.tolist(), strict=True))

    def registration_variance(self) -> float:
        """What the registration's doubt adds to the variance of the logarithm of the root mean square."""
        n = len(self.errors)
        along = np.einsum("nd,ndk->k", self.errors, self.factor) / n
        own = np.einsum("ndk,ndl->kl", self.factor, self.factor) / n
        return float(along @ along + 0.5 * (own**2).sum()) / self.square**2


def _part(table: ErrorTable, name: str) -> _Part:
    axes = list(_AXES[name])
    errors = table.rotation_error_rad if name == "attitude" else table.translation_error_m
    rows = axes if name == "attitude" else [3 + axis for axis in axes]
    ok = table.is_solved
    factor = table.registration_factor[ok][:, rows]
    return _Part(table.place[ok].astype(np.float64), errors[ok][:, axes], np.ones(int(ok.sum())), factor)


def _moments(key: str, unit: Unit, a: _Part, b: _Part, is_paired: bool) -> Change:
    places = min(len(set(a.place.tolist())), len(set(b.place.tolist())))
    if places < LEAST_PLACES:
        return _nothing(key, unit, _root(a), _root(b), places, is_paired)
    if a.square <= 0.0 or b.square <= 0.0:
        return _nothing(key, unit, _root(a), _root(b), places, is_paired, "a figure is exactly zero")
    variance, freedom = _difference_variance(a.influence(), b.influence(), is_paired)
    variance += a.registration_variance() + b.registration_variance()
    change = float(np.log(b.square / a.square)) / 2.0
    ends, p, reach = _student(change, float(np.sqrt(variance)), freedom)
    low, high = float(np.exp(ends[0])), float(np.exp(ends[1]))
    seen = float(np.exp(reach))
    return _found(key, unit, (_root(a), _root(b)), float(np.exp(change)), (low, high), p, seen, places, is_paired)


def _percentile(key: str, unit: Unit, a: _Part, b: _Part, is_paired: bool, rng: np.random.Generator) -> Change:
    lengths = [np.linalg.norm(part.errors, axis=1) for part in (a, b)]
    values = [float(np.quantile(x, _P95)) if len(x) else float("nan") for x in lengths]
    names = [np.unique(part.place) for part in (a, b)]
    places = min(len(n) for n in names)
    if places < LEAST_PLACES or min(values) <= 0.0:
        return _nothing(key, unit, values[0], values[1], places, is_paired)
    common = np.union1d(*names) if is_paired else None
    drawn = None if common is None else rng.multinomial(len(common), np.full(len(common), 1 / len(common)), _RESAMPLES)
    logs = []
    for part, length, own in zip((a, b), lengths, names, strict=True):
        if drawn is not None and common is not None:
            times = drawn[:, np.searchsorted(common, part.place)]
        else:
            times = rng.multinomial(len(own), np.full(len(own), 1 / len(own)), _RESAMPLES)[
                :, np.searchsorted(own, part.place)
            ]
        logs.append(np.log(np.maximum(_weighted_quantiles(length, times), 1e-300)))
    change = float(np.log(values[1] / values[0]))
    # The registration's doubt is that of the root mean square: it moves large and small errors alike.
    extra = np.sqrt(a.registration_variance() + b.registration_variance())
    each = logs[1] - logs[0] + extra * rng.normal(size=_RESAMPLES)
    spread = float(each.std(ddof=1))
    ends, p, reach = _student(change, spread, places - 1)
    low, high = float(np.exp(ends[0])), float(np.exp(ends[1]))
    return _found(
        key,
        unit,
        (values[0], values[1]),
        float(np.exp(change)),
        (low, high),
        p,
        float(np.exp(reach)),
        places,
        is_paired,
    )


def _availability(first: ErrorTable, second: ErrorTable, is_paired: bool) -> Change:
    fractions, influences = [], []
    for table in (first, second):
        names, index = np.unique(table.place, return_inverse=True)
        counts = np.bincount(index).astype(np.float64)
        solved = np.bincount(index, weights=table.is_solved.astype(np.float64))
        fraction = float(solved.sum() / counts.sum()) if counts.size else float("nan")
        fractions.append(fraction)
        effect = (solved - fraction * counts) / max(counts.sum(), 1.0)
        influences.append(dict(zip(names.astype(np.float64).tolist(), effect.tolist(), strict=True)))
    places = min(len(i) for i in influences)
    if places < LEAST_PLACES:
        return _nothing("availability", "percent", fractions[0], fractions[1], places, is_paired)
    variance, freedom = _difference_variance(influences[0], influences[1], is_paired)
    # Where every capture has a pose the data show no spread; one place more or less is then the least doubt.
    variance = max(variance, 1.0 / places**2 / 4.0)
    change = fractions[1] - fractions[0]
    ends, p, reach = _student(change, float(np.sqrt(variance)), freedom)
    shares = (fractions[0], fractions[1])
    return _found("availability", "percent", shares, change, ends, p, reach, places, is_paired)


# --- statistics ------------------------------------------------------------------------------------------------------


def _difference_variance(first: dict[float, float], second: dict[float, float], is_paired: bool) -> tuple[float, float]:
    """Variance of the difference of two figures from the influences of their places, and its degrees of freedom."""
    if is_paired:
        names = sorted(first.keys() | second.keys())
        each = np.array([second.get(n, 0.0) - first.get(n, 0.0) for n in names])
        S = len(names)
        return float((each**2).sum()) * S / (S - 1.0), S - 1.0
    parts = [np.array(list(i.values())) for i in (first, second)]
    variances = [float((x**2).sum()) * len(x) / (len(x) - 1.0) for x in parts]
    total = sum(variances)
    if total <= 0.0:
        return 0.0, float(min(len(x) for x in parts) - 1)
    # Welch and Satterthwaite.
    freedom = total**2 / sum(v**2 / (len(x) - 1.0) for v, x in zip(variances, parts, strict=True))
    return total, freedom


def _student(change: float, sigma: float, freedom: float) -> tuple[tuple[float, float], float, float]:
    """95 % interval, two-sided p-value, and half width."""
    reach = t_quantile(1.0 - _TAIL, freedom) * sigma
    if sigma <= 0.0:
        return (change, change), 1.0 if change == 0.0 else 0.0, 0.0
    p = 2.0 * t_tail(abs(change) / sigma, freedom)
    return (change - reach, change + reach), p, reach


def _weighted_quantiles(values: FloatArray, times: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> FloatArray:
    """95th percentile of values that occur so many times in each resample, shape (B,)."""
    order = np.argsort(values)
    grown = np.cumsum(times[:, order], axis=1)
    at = np.argmax(grown >= _P95 * grown[:, -1:], axis=1)
    return np.asarray(values[order][at], dtype=np.float64)


def _holm(p_values: Sequence[float]) -> list[float]:
    known = [(p, i) for i, p in enumerate(p_values) if np.isfinite(p)]
    adjusted = [float("nan")] * len(p_values)
    largest = 0.0
    for rank, (p, i) in enumerate(sorted(known)):
        largest = max(largest, min(1.0, p * (len(known) - rank)))
        adjusted[i] = largest
    return adjusted


def _named(change: Change, adjusted_p: float, allowed: float) -> Change:
    word: Word = change.word
    if np.isfinite(adjusted_p):
        is_share = change.unit == "percent"
        is_worse = change.high < -allowed if is_share else change.low > 1.0 + allowed
        is_better = change.low > 0.0 if is_share else change.high < 1.0
        if adjusted_p < LEVEL and is_worse:
            word = "worse"
        elif adjusted_p < LEVEL and is_better:
            word = "better"
        else:
            word = "no difference shown"
    return replace(change, adjusted_p=adjusted_p, word=word)


def _root(part: _Part) -> float:
    return float(np.sqrt(part.square)) if len(part.errors) else float("nan")


def _found(
    key: str,
    unit: Unit,
    values: tuple[float, float],
    change: float,
    ends: tuple[float, float],
    p: float,
    seen: float,
    places: int,
    is_paired: bool,
) -> Change:
    return Change(
        key, unit, *values, change, *ends, p, float("nan"), seen, places, is_paired, "no difference shown"
    )  # fmt: skip


def _nothing(key: str, unit: Unit, first: float, second: float, places: int, is_paired: bool, note: str = "") -> Change:
    nan = float("nan")
    change = second - first if unit == "percent" else second / first if first > 0.0 else nan
    open_low = -np.inf if unit == "percent" else 0.0
    said = note or f"only {places} places with a pose in one of the runs, at least {LEAST_PLACES} are needed"
    return Change(
        key, unit, first, second, change, open_low, np.inf, nan, nan, np.inf, places, is_paired, "inconclusive", said
    )
