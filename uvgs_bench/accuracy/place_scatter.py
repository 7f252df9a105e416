"""How the means of places scatter about a fit: the part of the sensor and the part of the carriage told apart.

The sensor's part turns and shifts a pose in the shape its covariance states; the carriage's part shifts it alike along
all axes and turns nothing. One factor for both would promise too much of one kind of direction and too little of the
other. Their sizes are the restricted maximum likelihood ones, in which what a fit has taken out of the residuals is
given back.

Source: H. D. Patterson and R. Thompson, Recovery of inter-block information when block sizes are unequal (1971), by
Fisher scoring; R. I. Jennrich and P. F. Sampson, Newton-Raphson and related algorithms (1976).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray

_MOST_ROUNDS = 30
_SETTLED = 1e-3
# Fewer degrees of freedom cannot tell two parts apart.
_LEAST_DEGREES = 60
# A part is never said to be less than this share of what is stated.
_LEAST_PART = 1e-3
# Multiplications up to which the library that multiplies matrices stays on one core.
_ONE_CORE = 250_000


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """Rows sorted by group, for sums of thousands of matrices.

    Args:
        order: Rows in the order of their groups, shape (N,).
        first: Where each group begins in that order, shape (S,).
    """

    order: NDArray[np.intp]
    first: NDArray[np.intp]

    @classmethod
    def of(cls, index: NDArray[np.intp]) -> Groups:
        """Group rows by running numbers, shape (N,), every number occurring."""
        order = np.argsort(index, kind="stable")
        return cls(order, np.searchsorted(index[order], np.arange(int(index.max()) + 1)))

    @property
    def count(self) -> int:
        """Number of groups."""
        return len(self.first)

    def sums(self, values: FloatArray) -> FloatArray:
        """Sums by group, shape (S, ...), of values (N, ...)."""
        out: FloatArray = np.add.reduceat(values[self.order], self.first, axis=0)
        return out


@dataclass(frozen=True, slots=True, eq=False)
class PlaceMeans:
    """Means of S places, in the left tangent of the pose.

    Args:
        residual: Mean residual of each place, shape (S, 6), rad and m.
        design: What the fitted directions do to it, shape (S, 6, r).
        information: Weight of each place in the fit, shape (S, 6, 6).
        parts: Covariances the mean would have by each source of scatter at its nominal size, shape (K, S, 6, 6).
    """

    residual: FloatArray
    design: FloatArray
    information: FloatArray
    parts: FloatArray

    @property
    def degrees_of_freedom(self) -> int:
        """Of the scatter about the fit."""
        return max(6 * len(self.residual) - len(self.design[0, 0]), 1)


def fit_parts(places: PlaceMeans) -> tuple[float, FloatArray]:
    """How large the scatter is, and each part of it, over their nominal sizes.

    Args:
        places: The places.

    Returns:
        Factor of the variance of all parts together, and of each, shape (K,); these are all alike when there are too
        few places to tell the parts apart.
    """
    common = _common_factor(places)
    size = np.full(len(places.parts), common)
    if common <= 0.0 or places.degrees_of_freedom < _LEAST_DEGREES:
        return common, size
    least = _LEAST_PART * common
    for _ in range(_MOST_ROUNDS):
        information, score = _scoring(places, size)
        found = np.maximum(np.linalg.lstsq(information, score, rcond=1e-9)[0], least)
        if (found <= least).any() and (found > least).any():
            # What is left when a part is at its bound.
            free, held = found > least, found <= least
            rest = score[free] - information[np.ix_(free, held)] @ found[held]
            found[free] = np.maximum(np.linalg.lstsq(information[np.ix_(free, free)], rest, rcond=1e-9)[0], least)
        change = float(np.abs(found / size - 1.0).max())
        size = found
        if change < _SETTLED:
            break
    return common, size


def fit_covariance(places: PlaceMeans, size: FloatArray, count: int) -> FloatArray:
    """Covariance of the first fitted directions, the others held, when places scatter as the parts say.

    Args:
        places: The places.
        size: Factors of the parts, shape (K,).
        count: Number of directions.

    Returns:
        The covariance, shape (count, count); the weights of the fit need not be the best ones.
    """
    V = np.einsum("k,ksij->sij", size, places.parts)
    design = places.design[:, :, :count]
    weighted = places.information @ design
    inverse = np.linalg.inv(crossed(design, weighted))
    middle = crossed(weighted, V @ weighted)
    out: FloatArray = inverse @ middle @ inverse
    return 0.5 * (out + out.T)


def _common_factor(places: PlaceMeans) -> float:
    """One factor for all parts: the whitened squares over their degrees of freedom."""
    inverse = np.linalg.inv(places.parts.sum(axis=0))
    left = _off_fit(places, inverse)
    return float(np.einsum("si,sij,sj->", left, inverse, left)) / places.degrees_of_freedom


def _off_fit(places: PlaceMeans, inverse: FloatArray) -> FloatArray:
    """Residuals less what the fitted directions explain at these weights, shape (S, 6)."""
    weighted = inverse @ places.design
    normal = crossed(places.design, weighted)
    step = np.linalg.solve(normal, np.einsum("sik,si->k", weighted, places.residual))
    return np.asarray(places.residual - places.design @ step)


def _scoring(places: PlaceMeans, size: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Equations whose solution are the next factors: traces of the projected parts, and squares they should explain."""
    inverse = np.linalg.inv(np.einsum("k,ksij->sij", size, places.parts))
    weighted = inverse @ places.design
    C = np.linalg.inv(crossed(places.design, weighted))
    pulled = np.einsum("sij,sj->si", inverse, _off_fit(places, inverse))
    scaled = inverse @ places.parts
    carried = [crossed(weighted, part @ weighted) for part in places.parts]
    K = len(size)
    information, score = np.empty((K, K)), np.empty(K)
    for k in range(K):
        score[k] = np.einsum("si,si->", pulled, np.einsum("sij,sj->si", places.parts[k], pulled))
        for n in range(k, K):
            both = scaled[k] @ scaled[n]
            shared = crossed(places.design, both @ weighted)
            trace = np.einsum("sii->", both) - 2.0 * np.trace(C @ shared) + np.trace(C @ carried[k] @ C @ carried[n])
            information[k, n] = information[n, k] = float(trace)
    return information, score


def crossed(a: FloatArray, b: FloatArray) -> FloatArray:
    """Sum of ``a^T b`` over rows, shape (i, j), of (N, 6, i) and (N, 6, j).

    In pieces too small to be spread over cores, whose threads wait for one another on a busy machine.
    """
    a, b = a.reshape(-1, a.shape[2]), b.reshape(-1, b.shape[2])
    total = np.zeros((a.shape[1], b.shape[1]))
    rows = max(_ONE_CORE // total.size, 1)
    for first in range(0, len(a), rows):
        total += a[first : first + rows].T @ b[first : first + rows]
    return total
