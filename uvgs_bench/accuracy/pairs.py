"""Relative errors between places: what is wrong with a motion, whoever knows where the camera stands.

Every place is paired with up to 20 others, k-th capture with k-th capture. Pairs that share a place are not
independent, so intervals leave out one place at a time.

Source: ASTM E2919 and ISO 9283 for the quantities; B. Efron, The Jackknife, the Bootstrap and Other Resampling Plans,
1982, chapter 3, and W. Hoeffding, A class of statistics with asymptotically normal distribution, 1948, for pairs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.clusters import LEAST_PLACES, TAIL, Estimate
from uvgs_bench.accuracy.distributions import t_quantile
from uvgs_bench.accuracy.pose_error import ErrorTable
from uvgs_bench.accuracy.tangent import hats, rotation_logs
from uvgs_bench.geometry import FloatArray

_OFFSETS, _SHOTS = 20, 5


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """P pairs of captures of different places.

    Args:
        i: Row of the first capture, shape (P,).
        j: Row of the second, shape (P,).
        place_i: Place of the first as a running number, shape (P,).
        place_j: Place of the second, shape (P,).
        place_count: Places.
        capture_count: Captures they are drawn from.
    """

    i: NDArray[np.intp]
    j: NDArray[np.intp]
    place_i: NDArray[np.intp]
    place_j: NDArray[np.intp]
    place_count: int
    capture_count: int

    @property
    def count(self) -> int:
        """Number of pairs."""
        return len(self.i)


def place_pairs(place: NDArray[np.int64]) -> Pairs:
    """Pairs of captures of different places, every place in about as many pairs as any other.

    Args:
        place: Place of each capture, shape (n,).

    Returns:
        The pairs; none with fewer than two places.
    """
    names, index, size = np.unique(place, return_inverse=True, return_counts=True)
    S = len(names)
    order = np.argsort(index, kind="stable")
    first = np.concatenate([[0], np.cumsum(size)])
    offsets = np.unique(np.linspace(1, S // 2, min(_OFFSETS, S // 2)).astype(int)) if S > 1 else np.empty(0, int)
    parts: list[tuple[NDArray[np.intp], NDArray[np.intp], int]] = []
    for offset in offsets.tolist():
        # Half a turn meets every pair twice.
        a = np.arange(S // 2 if 2 * offset == S else S)
        b = (a + offset) % S
        for k in range(min(_SHOTS, int(size.max()))):
            both = (size[a] > k) & (size[b] > k)
            parts.append((a[both], b[both], k))
    if not parts:
        empty = np.empty(0, dtype=np.intp)
        return Pairs(empty, empty, empty, empty, S, len(place))
    a = np.concatenate([part[0] for part in parts])
    b = np.concatenate([part[1] for part in parts])
    shot = np.concatenate([np.full(len(part[0]), part[2]) for part in parts])
    return Pairs(order[first[a] + shot], order[first[b] + shot], a, b, S, len(place))


def relative_errors(table: ErrorTable, pairs: Pairs) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``F = (T_ref,i^-1 T_ref,j)^-1 (T_obs,i^-1 T_obs,j)`` for pairs of captures, in the beacon's axes.

    Args:
        table: Errors, all with a pose.
        pairs: Pairs of its rows.

    Returns:
        Translations of F, shape (P, 3), m; its rotation vectors, shape (P, 3), rad; and the effect of the
        registration's doubt on both to first order, rotation first, shape (P, 6, 12), rad and m.
    """
    from scipy.spatial.transform import Rotation

    R_ref, t_ref = table.predicted_R, table.predicted_t_m
    R_obs = Rotation.from_rotvec(table.rotation_error_rad).as_matrix() @ R_ref
    t_obs = t_ref + table.translation_error_m
    i, j = pairs.i, pairs.j
    by_ref = _between(R_ref, t_ref, i, j)
    by_obs = _between(R_obs, t_obs, i, j)
    back = by_ref[0].transpose(0, 2, 1)
    shift = np.einsum("pij,pj->pi", back, by_obs[1] - by_ref[1])
    turn = rotation_logs(back @ by_obs[0])
    to_beacon = R_ref[j].transpose(0, 2, 1)
    factor = table.registration_factor
    lever = hats(t_ref[j] - t_ref[i])
    moved = factor[j, 3:] - factor[i, 3:] + lever @ factor[i, :3]
    turned = factor[j, :3] - factor[i, :3]
    return shift, turn, np.concatenate([to_beacon @ turned, to_beacon @ moved], axis=1)


def _between(R: FloatArray, t: FloatArray, i: NDArray[np.intp], j: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """``T_i^-1 T_j`` for pairs of rows."""
    back = R[i].transpose(0, 2, 1)
    return back @ R[j], np.einsum("pij,pj->pi", back, t[j] - t[i])


def pair_rms(values: FloatArray, factor: FloatArray, pairs: Pairs) -> Estimate:
    """Root mean square length over pairs, with the doubt that pairs share places and the registration.

    Args:
        values: One vector per pair, shape (P, d).
        factor: Effect of the registration's doubt on them, shape (P, d, 12).
        pairs: The pairs.

    Returns:
        The figure; without an interval when there are too few places.
    """
    S = pairs.place_count
    if pairs.count == 0:
        return Estimate(np.nan, 0.0, np.inf, S, pairs.capture_count, "needs captures at two places or more")
    squares = (values**2).sum(axis=1)
    mean = float(squares.mean())
    if S < LEAST_PLACES:
        note = f"only {S} stations, at least {LEAST_PLACES} are needed for an interval"
        return Estimate(float(np.sqrt(mean)), 0.0, np.inf, S, pairs.capture_count, note)
    if mean <= 0.0:
        return Estimate(0.0, 0.0, 0.0, S, pairs.capture_count)
    of_place = np.bincount(pairs.place_i, squares, S) + np.bincount(pairs.place_j, squares, S)
    number = (np.bincount(pairs.place_i, minlength=S) + np.bincount(pairs.place_j, minlength=S)).astype(np.float64)
    left_out = (squares.sum() - of_place) / (pairs.count - number)
    own = (S - 1.0) / S * float(((left_out - left_out.mean()) ** 2).sum())
    shared = float((factor**2).sum()) / pairs.count
    through = 2.0 * np.einsum("pd,pdk->k", values, factor) / pairs.count
    sigma = float(np.sqrt(own + through @ through)) / mean
    reach = t_quantile(1.0 - TAIL, S - 1) * sigma
    low, high = mean * np.exp(-reach) - shared, mean * np.exp(min(reach, 50.0))
    ends = float(np.sqrt(max(low, 0.0))), float(np.sqrt(high))
    return Estimate(float(np.sqrt(mean)), *ends, S, pairs.capture_count)


def distance_figures(t_obs_m: FloatArray, t_ref_m: FloatArray, pairs: Pairs) -> tuple[Estimate, Estimate]:
    """Distance accuracy and repeatability after ISO 9283, root mean square over pairs of places.

    Args:
        t_obs_m: Observed positions, shape (n, 3), m.
        t_ref_m: Reference positions, shape (n, 3), m.
        pairs: Pairs of captures.

    Returns:
        AD and RD; no RD without places that have two captures.
    """
    if pairs.count == 0:
        nothing = Estimate(np.nan, 0.0, np.inf, pairs.place_count, pairs.capture_count, "needs captures at two places")
        return nothing, nothing
    observed = np.linalg.norm(t_obs_m[pairs.j] - t_obs_m[pairs.i], axis=1)
    excess = observed - np.linalg.norm(t_ref_m[pairs.j] - t_ref_m[pairs.i], axis=1)
    key = pairs.place_i * pairs.place_count + pairs.place_j
    _, index, count = np.unique(key, return_inverse=True, return_counts=True)
    mean = np.bincount(index, excess) / count
    first = np.unique(index, return_index=True)[1]
    by_pair = Pairs(
        pairs.i[first], pairs.j[first], pairs.place_i[first], pairs.place_j[first],
        pairs.place_count, pairs.capture_count,
    )  # fmt: skip
    accuracy = pair_rms(mean[:, None], np.zeros((len(mean), 1, 12)), by_pair)
    repeated = count > 1
    if not repeated.any():
        note = "needs places with two captures or more"
        return accuracy, Estimate(np.nan, 0.0, np.inf, pairs.place_count, pairs.capture_count, note)
    variance = np.bincount(index, (excess - mean[index]) ** 2) / np.maximum(count - 1, 1)
    spread = 3.0 * np.sqrt(variance[repeated])
    chosen = Pairs(
        by_pair.i[repeated], by_pair.j[repeated], by_pair.place_i[repeated], by_pair.place_j[repeated],
        pairs.place_count, pairs.capture_count,
    )  # fmt: skip
    return accuracy, pair_rms(spread[:, None], np.zeros((len(spread), 1, 12)), chosen)
