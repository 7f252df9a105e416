"""How well a leader was followed: tracking error, overshoot, time in tolerance, what every loss of sight cost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray

# A gap of fewer cycles without a pose is a lost capture, not a loss of sight.
_LOSS_CYCLES = 3
# Captures that were never looked at say nothing about sight.
DROPPED, BUSY = "dropped", "busy"
_TRAFFIC = frozenset({DROPPED, BUSY})
# Recovered: in tolerance from here on for so long, s.
_RECOVERED_S = 0.5
# A leg shorter than this has no direction worth overshooting, m.
_LEG_M = 1e-3
# Rounding of a record, m.
_NO_STEP_M = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class FollowTrack:
    """The errors of a session over time, one row per capture.

    Args:
        t_s: Instants, shape (n,), s, ascending.
        error_m: Position off the station, leader's axes, shape (n, 3), m; NaN where unknown.
        error_rad: Rotation vector off the wanted attitude, shape (n, 3), rad; NaN where unknown, which is no fault.
        miss_m: Position off the station in world axes, shape (n, 3), m; NaN where unknown.
        leader_m: Place of the leader in the world, shape (n, 3), m; NaN where unknown.
        is_fresh: Whether the capture gave a pose that was believed, shape (n,).
        is_calm: Whether the leader had long not accelerated, shape (n,).
        place: Number of the place the leader reached last, shape (n,).
        mode: What the law did, one per row.
        reason: Why there was no believed pose, one per row; empty where there was.
    """

    t_s: FloatArray
    error_m: FloatArray
    error_rad: FloatArray
    miss_m: FloatArray
    leader_m: FloatArray
    is_fresh: NDArray[np.bool_]
    is_calm: NDArray[np.bool_]
    place: NDArray[np.int64]
    mode: Sequence[str]
    reason: Sequence[str]


@dataclass(frozen=True, slots=True)
class LossBehaviour:
    """What one loss of sight did.

    Args:
        begin_s: When the first capture of it was taken, s.
        duration_s: Until the next believed pose, s; until the end when there was none.
        reasons: Why there was no pose, the most frequent first.
        modes: What the law did, in order.
        worst_m: Largest position error during it and until recovery, m.
        recovery_s: From the next believed pose until in tolerance again, s; None when that never came.
    """

    begin_s: float
    duration_s: float
    reasons: tuple[str, ...]
    modes: tuple[str, ...]
    worst_m: float
    recovery_s: float | None


@dataclass(frozen=True, slots=True)
class FollowQuality:
    """The figures of a session. Errors are Euclidean norms.

    Args:
        capture_count: Captures.
        pose_share: Share of them that gave a believed pose.
        acquired_s: When the error was first in tolerance, s; None when never.
        rms_m: Root mean square of the position error from then on, m.
        worst_m: Its largest, m.
        rms_rad: The same for the attitude, rad.
        worst_rad: Its largest, rad.
        in_tolerance: Share of the captures from then on within both tolerances.
        steady_count: Captures with the leader calm and no loss of sight shortly before.
        steady_rms_m: Root mean square of the position error over them, m.
        steady_worst_m: Its largest, m.
        cruise_count: Those of them with the leader on its way.
        cruise_worst_m: Largest position error over them, m.
        overshoot_m: Largest way past a stop of the leader, along the way it came, m; None when it never stopped.
        losses: Each loss of sight.
        lost_capture_count: Captures without a believed pose that belong to no loss of sight.
    """

    capture_count: int
    pose_share: float
    acquired_s: float | None
    rms_m: float
    worst_m: float
    rms_rad: float
    worst_rad: float
    in_tolerance: float
    steady_count: int
    steady_rms_m: float
    steady_worst_m: float
    cruise_count: int
    cruise_worst_m: float
    overshoot_m: float | None
    losses: tuple[LossBehaviour, ...]
    lost_capture_count: int


def judge_track(track: FollowTrack, tolerance_m: float, tolerance_rad: float, settle_s: float) -> FollowQuality:
    """Figures of a track.

    Args:
        track: The track.
        tolerance_m: Position error that counts as in tolerance, m.
        tolerance_rad: Attitude error that counts as in tolerance, rad.
        settle_s: How long after a loss of sight an error counts as steady again, s, unless recovery took longer.

    Returns:
        The figures; NaN where nothing can be said.
    """
    error_m = np.linalg.norm(track.error_m, axis=1)
    error_rad = np.linalg.norm(track.error_rad, axis=1)
    is_known = np.isfinite(error_m)
    within = is_known & (error_m <= tolerance_m) & ~(error_rad > tolerance_rad)
    spans = _losses(track)
    losses = tuple(_behaviour(track, error_m, within, begin, end) for begin, end in spans)
    is_upset = np.zeros(len(error_m), dtype=bool)
    for loss in losses:
        recovery_s = np.inf if loss.recovery_s is None else loss.recovery_s
        until_s = loss.begin_s + loss.duration_s + max(settle_s, recovery_s)
        is_upset |= (track.t_s >= loss.begin_s) & (track.t_s <= until_s)
    first = int(np.argmax(within)) if within.any() else len(error_m)
    after = is_known & (np.arange(len(error_m)) >= first)
    steady = after & track.is_calm & ~is_upset
    cruise = steady & _is_moving(track)
    lost = sum(end - begin for begin, end in spans)
    return FollowQuality(
        capture_count=len(error_m),
        pose_share=float(np.mean(track.is_fresh)) if len(error_m) else np.nan,
        acquired_s=float(track.t_s[first]) if first < len(error_m) else None,
        rms_m=_rms(error_m[after]),
        worst_m=_worst(error_m[after]),
        rms_rad=_rms(error_rad[after]),
        worst_rad=_worst(error_rad[after]),
        in_tolerance=float(np.mean(within[after])) if after.any() else np.nan,
        steady_count=int(steady.sum()),
        steady_rms_m=_rms(error_m[steady]),
        steady_worst_m=_worst(error_m[steady]),
        cruise_count=int(cruise.sum()),
        cruise_worst_m=_worst(error_m[cruise]),
        overshoot_m=_overshoot(track),
        losses=losses,
        lost_capture_count=int((~track.is_fresh).sum()) - lost,
    )


def _losses(track: FollowTrack) -> list[tuple[int, int]]:
    """Spans of captures without a believed pose after the first one, long enough to be a loss of sight."""
    spans: list[tuple[int, int]] = []
    begin: int | None = None
    seen = False
    for i, is_fresh in enumerate([*track.is_fresh.tolist(), True]):
        if is_fresh:
            if begin is not None and i - begin >= _LOSS_CYCLES and not _TRAFFIC.issuperset(track.reason[begin:i]):
                spans.append((begin, i))
            begin, seen = None, True
        elif begin is None and seen:
            begin = i
    return spans


def _behaviour(
    track: FollowTrack, error_m: FloatArray, within: NDArray[np.bool_], begin: int, end: int
) -> LossBehaviour:
    n = len(error_m)
    until_s = float(track.t_s[end]) if end < n else float(track.t_s[-1])
    recovery_s, recovered = None, n
    for i in range(end, n):
        span = (track.t_s >= track.t_s[i]) & (track.t_s <= track.t_s[i] + _RECOVERED_S)
        if within[span].all():
            recovery_s, recovered = float(track.t_s[i] - track.t_s[end]), i
            break
    reasons = Counter(reason for reason in track.reason[begin:end] if reason)
    modes = tuple(dict.fromkeys(track.mode[begin:end]))
    return LossBehaviour(
        begin_s=float(track.t_s[begin]),
        duration_s=until_s - float(track.t_s[begin]),
        reasons=tuple(reason for reason, _ in reasons.most_common()),
        modes=modes,
        worst_m=_worst(error_m[begin : recovered + 1]),
        recovery_s=recovery_s,
    )


def _is_moving(track: FollowTrack) -> NDArray[np.bool_]:
    """Whether the leader moves between a capture and the one before."""
    steps_m = np.linalg.norm(np.diff(track.leader_m, axis=0, prepend=track.leader_m[:1]), axis=1)
    moves: NDArray[np.bool_] = steps_m > _NO_STEP_M
    return moves


def _overshoot(track: FollowTrack) -> float | None:
    """Largest way past a stop of the leader, along the leg it came by, until it reaches the next place."""
    changes = np.flatnonzero(np.diff(track.place)) + 1
    found = []
    for k, i in enumerate(changes):
        came_from = changes[k - 1] if k else 0
        leg = track.leader_m[i] - track.leader_m[came_from]
        length = float(np.linalg.norm(leg))
        if not length > _LEG_M:
            continue
        until = changes[k + 1] if k + 1 < len(changes) else len(track.place)
        along = track.miss_m[i:until] @ (leg / length)
        if np.isfinite(along).any():
            found.append(max(float(np.nanmax(along)), 0.0))
    return max(found) if found else None


def _rms(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan


def _worst(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else np.nan
