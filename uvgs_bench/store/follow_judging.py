"""From a follow session on disk to its figures: shared by those who lead sessions and those who report them."""

from __future__ import annotations

import numpy as np

from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import so3_log
from uvgs_bench.navigation.follow_quality import FollowQuality, FollowTrack, judge_track
from uvgs_bench.store.follow_runs import FollowCycle, FollowRun
from uvgs_bench.units import m_from_mm, rad_from_deg, s_from_ns

_NOWHERE = np.full(3, np.nan)


def follow_track(run: FollowRun) -> FollowTrack:
    """The errors of a session: true where the leader is known, else as the sensor saw them.

    Args:
        run: The session.

    Returns:
        Its track; time counts from the first capture.
    """
    settle_s = _figure(run, "settle_s", 3.0)
    station = run.manifest.station
    errors = [_errors(cycle, station) for cycle in run.cycles]
    begun_ns = run.cycles[0].t_ns if run.cycles else 0
    return FollowTrack(
        t_s=np.array([s_from_ns(c.t_ns - begun_ns) for c in run.cycles]),
        error_m=np.array([e[0] for e in errors]).reshape(-1, 3),
        # A gantry follows by its linear axes: of attitudes it knows nothing.
        error_rad=np.array([e[1] * (np.nan if run.manifest.plant == "gantry" else 1.0) for e in errors]).reshape(-1, 3),
        miss_m=np.array([e[2] for e in errors]).reshape(-1, 3),
        leader_m=np.array([_NOWHERE if c.leader is None else c.leader.t_m for c in run.cycles]).reshape(-1, 3),
        is_fresh=np.array([c.is_accepted for c in run.cycles], dtype=bool),
        is_calm=np.array([c.calm_s is None or c.calm_s >= settle_s for c in run.cycles], dtype=bool),
        place=np.array([c.place for c in run.cycles], dtype=np.int64),
        mode=[c.mode for c in run.cycles],
        reason=[c.reason for c in run.cycles],
    )


def judge_follow(run: FollowRun) -> FollowQuality:
    """The figures of a session, by the tolerances it was begun with.

    Args:
        run: The session.

    Returns:
        The figures.
    """
    tolerance_m = m_from_mm(_figure(run, "tolerance_mm", 10.0))
    tolerance_rad = rad_from_deg(_figure(run, "tolerance_deg", 2.0))
    return judge_track(follow_track(run), tolerance_m, tolerance_rad, _figure(run, "settle_s", 3.0))


def verdict_of(run: FollowRun, quality: FollowQuality) -> tuple[str, str]:
    """Verdict and its reason in one line.

    Args:
        run: The session.
        quality: Its figures.

    Returns:
        ``pass``, ``fail`` or ``inconclusive``, and why.
    """
    limit_m = m_from_mm(_figure(run, "tolerance_mm", 10.0))
    if run.ending == "aborted":
        return "fail", f"gave up: {run.reason}"
    margins = run.manifest.facts.get("margins")
    if isinstance(margins, dict) and float(margins.get("spectral_radius", 0.0)) >= 1.0:
        return "fail", "at the latency it had, the loop is unstable"
    if quality.acquired_s is None:
        return "fail", "the station was never reached within tolerance"
    if run.ending != "completed":
        return "inconclusive", f"the session was {run.ending or 'cut off'}: {run.reason or 'no reason known'}"
    if quality.steady_count < 2:
        return "inconclusive", "the leader was never calm for long enough to tell the steady error"
    if quality.steady_worst_m > limit_m:
        return "fail", "the steady error exceeds the tolerance"
    unrecovered = [loss for loss in quality.losses if loss.recovery_s is None]
    if unrecovered:
        return "fail", f"not in tolerance again after the loss of sight at {unrecovered[0].begin_s:.1f} s"
    return "pass", "the steady error keeps the tolerance"


def _errors(cycle: FollowCycle, station: Pose) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position error (leader's axes, m), rotation vector (rad), position error in world axes (m)."""
    seen = cycle.sensed if cycle.leader is None else cycle.leader.inverse() @ cycle.body
    if seen is None:
        return _NOWHERE, _NOWHERE, _NOWHERE
    error_m = seen.t_m - station.t_m
    in_world = _NOWHERE if cycle.leader is None else cycle.leader.R @ error_m
    return error_m, so3_log(station.R.T @ seen.R), in_world


def _figure(run: FollowRun, name: str, default: float) -> float:
    scenario = run.manifest.facts.get("scenario")
    value = scenario.get(name, default) if isinstance(scenario, dict) else default
    return float(value)
