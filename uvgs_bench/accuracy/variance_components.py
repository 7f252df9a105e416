"""How much the mean of a visit scatters, and why: noise of captures, what a place's visits share, how a carriage stops.

The three parts have different shapes: noise is anew in every capture, a place's error is the same in all its visits and
shaped like noise, and stopping is anew in every visit, alike along all axes and without turning. Their sizes are those
that make the residuals most likely once everything one could blame is fitted (restricted maximum likelihood), so that
an error with a cause is not taken for scatter.

Source: H. D. Patterson and R. Thompson, Recovery of inter-block information when block sizes are unequal (1971).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray

# Logarithms of the parts of noise, place and stopping are looked for within these bounds of their starts.
_REACH = 12.0
_RANK = 1e-7
_EVALUATIONS = 160
_TOLERANCE = 1e-3
_STEP = 0.02
# Multiplications up to which the library that multiplies matrices stays on one core.
_ONE_CORE = 250_000


@dataclass(frozen=True, slots=True, eq=False)
class Visits:
    """Mean residuals of the visits of a run, those of a place side by side.

    Args:
        residual: Mean left tangent of each visit, shape (V, 6), rad and m.
        noise: Covariance of each mean by the sensor's own word, shape (V, 6, 6).
        single: Covariance of one capture of each visit by the sensor's own word, shape (V, 6, 6).
        blocks: Rows of the visits of each place, one array (number of places, k) for every number k of visits.
        within: Sum of squares of the captures about their visits, whitened by the sensor's own word.
        within_freedom: Its degrees of freedom.
    """

    residual: FloatArray
    noise: FloatArray
    single: FloatArray
    blocks: tuple[NDArray[np.intp], ...]
    within: float
    within_freedom: int


@dataclass(frozen=True, slots=True)
class Scatter:
    """The parts of a visit's variance.

    Args:
        noise: Variance of captures over the sensor's own word.
        place: Variance of what a place's visits share over the sensor's word of one capture.
        stopping_m2: Variance per axis of where a visit stops, m^2.
    """

    noise: float
    place: float
    stopping_m2: float


def visits_of(
    residual: FloatArray, covariance: FloatArray, station: NDArray[np.int64], place: NDArray[np.int64]
) -> tuple[Visits, NDArray[np.intp]]:
    """Average captures by visit.

    Args:
        residual: Left tangents, shape (N, 6), rad and m.
        covariance: Their covariances by the sensor's own word, shape (N, 6, 6).
        station: Visit of each capture, shape (N,).
        place: Place of each capture, shape (N,).

    Returns:
        The visits, and the visit of each capture, shape (N,).
    """
    _, first, of_visit, size = np.unique(station, return_index=True, return_inverse=True, return_counts=True)
    V = len(first)
    mean = means(residual, of_visit)
    single = means(covariance, of_visit)
    off = np.linalg.solve(np.linalg.cholesky(covariance), (residual - mean[of_visit])[:, :, None])
    _, of_place = np.unique(place[first], return_inverse=True)
    order = np.argsort(of_place, kind="stable")
    counts = np.bincount(of_place)
    starts = np.cumsum(counts) - counts
    blocks = tuple(
        np.array([order[s : s + k] for s in starts[counts == k]], dtype=np.intp) for k in np.unique(counts).tolist()
    )
    freedom = 6 * (len(residual) - V)
    return Visits(mean, single / size[:, None, None], single, blocks, float((off**2).sum()), freedom), of_visit


def means(values: FloatArray, index: NDArray[np.intp]) -> FloatArray:
    """Means of groups, shape (G, ...), of values (n, ...) by the group of each, shape (n,)."""
    size = np.bincount(index)
    out = np.zeros((len(size), *values.shape[1:]))
    np.add.at(out, index, values)
    return out / size.reshape(-1, *([1] * (values.ndim - 1)))


def whitened(visits: Visits, scatter: Scatter, columns: FloatArray) -> tuple[FloatArray, float]:
    """Columns over visits made independent and of unit variance.

    Args:
        visits: The visits.
        scatter: How they scatter.
        columns: Columns, shape (V, 6, p).

    Returns:
        Whitened columns, shape (6 V, p), and the logarithm of the determinant of the covariance.
    """
    rows, determinant = [], 0.0
    stop = np.zeros((6, 6))
    stop[3:, 3:] = scatter.stopping_m2 * np.eye(3)
    for block in visits.blocks:
        count, k = block.shape
        S = np.zeros((count, k, 6, k, 6))
        shared = scatter.place * visits.single[block].mean(axis=1)
        for i in range(k):
            for j in range(k):
                S[:, i, :, j] = shared
            S[:, i, :, i] += scatter.noise * visits.noise[block[:, i]] + stop
        L = np.linalg.cholesky(S.reshape(count, 6 * k, 6 * k))
        determinant += 2.0 * float(np.log(np.diagonal(L, axis1=1, axis2=2)).sum())
        rows.append(np.linalg.solve(L, columns[block].reshape(count, 6 * k, -1)).reshape(count * 6 * k, -1))
    return np.concatenate(rows), determinant


def fit_scatter(visits: Visits, explained: FloatArray, stopping_m: float) -> Scatter:
    """The most likely parts of the scatter.

    Args:
        visits: The visits.
        explained: Everything that may have shifted them, columns, shape (V, 6, p).
        stopping_m: Standard deviation per axis of where a visit stops as a start, m.

    Returns:
        The scatter.
    """
    from scipy.optimize import minimize

    start = Scatter(1.0, 0.1, max(stopping_m, 1e-6) ** 2)
    V = len(visits.residual)
    unit, _ = whitened(visits, start, explained)
    # Which columns count is settled once, so that likelihoods compare.
    length = np.linalg.norm(unit, axis=0)
    kept = length > 0.0
    _, size, turn = np.linalg.svd(unit[:, kept] / length[kept], full_matrices=False)
    turn = turn[size > _RANK * size[0]]
    basis = (explained[:, :, kept] / length[kept]) @ turn.T
    table = np.concatenate([basis, visits.residual[:, :, None]], axis=2)

    def scatter_at(x: FloatArray) -> Scatter:
        a, b, c = np.exp(np.clip(x, -_REACH, _REACH))
        return Scatter(float(a), float(start.place * b), float(start.stopping_m2 * c))

    whiten = _Whitening(visits, table)

    def cost(x: FloatArray) -> float:
        scatter = scatter_at(x)
        white, determinant = whiten.by(scatter)
        # One triangle holds both: the determinant of what is explained, and what is left of the residual.
        diagonal = np.diagonal(np.linalg.cholesky(_gram(white)))
        within = visits.within_freedom * np.log(scatter.noise) + visits.within / scatter.noise
        # A weak pull keeps parts the data say nothing of near their starts.
        pull = 1e-3 * float(x @ x)
        return float(determinant + 2.0 * np.log(diagonal[:-1]).sum() + diagonal[-1] ** 2 + within + pull)

    guess = np.array([0.0, 0.0, 0.0])
    if visits.within_freedom >= V:
        guess[0] = np.log(max(visits.within / visits.within_freedom, 1e-3))
    simplex = guess + np.concatenate([np.zeros((1, 3)), 1.5 * np.eye(3)])
    fitted = minimize(
        cost,
        guess,
        method="Nelder-Mead",
        options={"maxfev": _EVALUATIONS, "xatol": _STEP, "fatol": _TOLERANCE, "initial_simplex": simplex},
    )
    return scatter_at(np.asarray(fitted.x))


class _Whitening:
    """One table whitened by many scatters: places visited once are turned to where all their parts are diagonal."""

    def __init__(self, visits: Visits, table: FloatArray) -> None:
        alone = [block[:, 0] for block in visits.blocks if block.shape[1] == 1]
        once = np.concatenate(alone) if alone else np.empty(0, dtype=np.intp)
        # With C C^T the noise of one capture, parts are multiples of C C^T and what stopping adds to it.
        C = np.linalg.cholesky(visits.single[once])
        back = np.linalg.inv(C)
        stop, turn = np.linalg.eigh(back[:, :, 3:] @ back[:, :, 3:].transpose(0, 2, 1))
        # Stopping shifts and does not turn: three directions know nothing of it but rounding.
        self._stop = np.maximum(stop, 0.0)
        self._turned = turn.transpose(0, 2, 1) @ back @ table[once]
        # The mean of a visit is as noisy as one capture over their number.
        self._share = visits.noise[once, 0, 0] / visits.single[once, 0, 0]
        self._determinant = 2.0 * float(np.log(np.diagonal(C, axis1=1, axis2=2)).sum())
        self._others = replace(visits, blocks=tuple(block for block in visits.blocks if block.shape[1] > 1))
        self._table = table

    def by(self, scatter: Scatter) -> tuple[FloatArray, float]:
        """As ``whitened``; the rows are turned, which no sum of squares notices."""
        own = scatter.place + scatter.noise * self._share
        variance = own[:, None] + scatter.stopping_m2 * self._stop
        rows = (self._turned / np.sqrt(variance)[:, :, None]).reshape(-1, self._table.shape[2])
        determinant = self._determinant + float(np.log(variance).sum())
        if not self._others.blocks:
            return rows, determinant
        more, further = whitened(self._others, scatter, self._table)
        return np.concatenate([rows, more]), determinant + further


def _gram(columns: FloatArray) -> FloatArray:
    """``columns^T columns`` in pieces too small to be spread over cores: waking them costs ten times the work."""
    p = columns.shape[1]
    rows = max(_ONE_CORE // (p * p), 1)
    total = np.zeros((p, p))
    for first in range(0, len(columns), rows):
        piece = columns[first : first + rows]
        total += piece.T @ piece
    return total
