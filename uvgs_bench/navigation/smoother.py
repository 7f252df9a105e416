"""The Rauch-Tung-Striebel smoother: every state given all measurements, those before it and those after. Offline.

Source: H. E. Rauch, F. Tung, C. T. Striebel, Maximum likelihood estimates of linear dynamic systems, 1965; carried out
on the errors of the states.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.geometry.se3 import so3_log
from uvgs_bench.navigation.error_state_filter import POSE_ROWS, FilterConfig, packed, unpacked
from uvgs_bench.navigation.filter_kernels import (
    ERROR_SIZE,
    correct,
    innovation_covariance,
    move,
    pose_residual,
    propagate,
)
from uvgs_bench.navigation.imu import ImuSamples
from uvgs_bench.navigation.states import NavigationState, PoseMeasurement
from uvgs_bench.units import s_from_ns


def smooth(
    start: NavigationState,
    imu: ImuSamples,
    measurements: Sequence[PoseMeasurement],
    at_ns: NDArray[np.int64],
    config: FilterConfig,
) -> tuple[NavigationState, ...]:
    """States given everything.

    Args:
        start: Where it begins.
        imu: Readings, from the start to beyond the last instant asked for.
        measurements: Believed poses; there is no gate here.
        at_ns: Instants asked for, shape (n,), ns, ascending, not before the start.
        config: Parameters of the filter.

    Returns:
        One state per instant.
    """
    nodes = sorted({start.t_ns, *(int(t) for t in at_ns), *(m.t_ns for m in measurements if m.t_ns > start.t_ns)})
    nodes = [t for t in nodes if t >= start.t_ns]
    by_time: dict[int, list[PoseMeasurement]] = {}
    for m in measurements:
        by_time.setdefault(m.t_ns, []).append(m)
    noise, gravity = config.noise.vector(), read_only(config.gravity_mps2)
    state, P = packed(start), np.array(start.covariance)
    after = [(state.copy(), P.copy())]
    carried: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for t_ns, end_ns in itertools.pairwise(nodes):
        Phi = np.eye(ERROR_SIZE)
        for begin_ns, until_ns, reading in _steps(imu, t_ns, end_ns):
            propagate(state, P, Phi, reading, s_from_ns(until_ns - begin_ns), noise, gravity, True)
        carried.append((state.copy(), P.copy(), Phi))
        for m in by_time.get(end_ns, ()):
            residual = pose_residual(state, m.world_from_body.R, m.world_from_body.t_m)
            L, _ = innovation_covariance(P, m.covariance, POSE_ROWS, residual)
            correct(state, P, L, m.covariance, POSE_ROWS, residual)
        after.append((state.copy(), P.copy()))
    smoothed = [after[-1]]
    for (x, P), (x_carried, P_carried, Phi) in zip(reversed(after[:-1]), reversed(carried), strict=True):
        x_next, P_next = smoothed[-1]
        gain = np.linalg.solve(P_carried, Phi @ P).T
        x_new = x.copy()
        move(x_new, gain @ _difference(x_next, x_carried))
        P_new = P + gain @ (P_next - P_carried) @ gain.T
        smoothed.append((x_new, 0.5 * (P_new + P_new.T)))
    smoothed.reverse()
    place = {t: k for k, t in enumerate(nodes)}
    return tuple(unpacked(int(t), *smoothed[place[int(t)]]) for t in at_ns)


def _steps(imu: ImuSamples, start_ns: int, end_ns: int) -> list[tuple[int, int, FloatArray]]:
    """Begin, end and mean reading of each step between two instants, as the filter takes them."""
    first = int(np.searchsorted(imu.t_ns, start_ns, side="right"))
    out, now_ns, k = [], start_ns, first
    while now_ns < end_ns:
        k_here, k_before = min(k, len(imu) - 1), max(min(k, len(imu)) - 1, 0)
        reading = np.concatenate(
            (
                0.5 * (imu.acceleration_mps2[k_before] + imu.acceleration_mps2[k_here]),
                0.5 * (imu.rate_radps[k_before] + imu.rate_radps[k_here]),
            )
        )
        until_ns = end_ns if k >= len(imu) else min(int(imu.t_ns[k]), end_ns)
        out.append((now_ns, until_ns, reading))
        now_ns, k = until_ns, k + 1
    return out


def _difference(a: FloatArray, b: FloatArray) -> FloatArray:
    """The error that moves state b to state a, shape (15,)."""
    turn = so3_log(np.ascontiguousarray(a[6:15].reshape(3, 3) @ b[6:15].reshape(3, 3).T))
    return np.concatenate((a[:6] - b[:6], turn, a[15:] - b[15:]))
