"""What the report of a follow session is made of, in the arrays its drawings need."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import euler_zyx_from_rotation
from uvgs_bench.navigation.follow_quality import FollowQuality, FollowTrack
from uvgs_bench.store.follow_judging import follow_track, judge_follow, verdict_of
from uvgs_bench.store.follow_runs import FollowCycle, FollowRun
from uvgs_bench.units import deg_from_rad


@dataclass(frozen=True, slots=True, eq=False)
class FollowEvidence:
    """A follow session with everything that is told of it; one row per capture.

    Args:
        run: The session.
        quality: Its figures.
        verdict: ``pass``, ``fail`` or ``inconclusive``.
        headline: Why.
        track: Its errors.
        is_true: Whether leader and follower are truly known; otherwise everything is drawn in the leader's axes.
        leader_m: The leader, shape (n, 3), m.
        wanted_m: Where the follower was to be, shape (n, 3), m.
        true_m: Where it was, shape (n, 3), m; NaN when unknown.
        sensed_m: Where the sensor saw it, shape (n, 3), m; NaN without a pose.
        wanted_deg: Wanted yaw, pitch, roll, shape (n, 3), deg.
        true_deg: True ones; NaN when unknown.
        sensed_deg: Sensed ones; NaN without a pose.
        hues: Instant, s, and hue from then on, for each change of the leader's hue, the first included; empty when it
            never changed.
    """

    run: FollowRun
    quality: FollowQuality
    verdict: str
    headline: str
    track: FollowTrack
    is_true: bool
    leader_m: FloatArray
    wanted_m: FloatArray
    true_m: FloatArray
    sensed_m: FloatArray
    wanted_deg: FloatArray
    true_deg: FloatArray
    sensed_deg: FloatArray
    hues: tuple[tuple[float, str], ...]

    def fact(self, *keys: str) -> float | None:
        """A number the session was begun with, by its path in the manifest; None when it is not there."""
        value: object = self.run.manifest.facts
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        return float(value) if isinstance(value, int | float) else None


def follow_evidence(run: FollowRun) -> FollowEvidence:
    """Everything a report tells of a session.

    Args:
        run: The session, finished or not.

    Returns:
        The evidence.
    """
    quality = judge_follow(run)
    verdict, headline = verdict_of(run, quality)
    track = follow_track(run)
    is_true = any(cycle.leader is not None for cycle in run.cycles)
    rows = [_row(cycle, run.manifest.station, is_true) for cycle in run.cycles]
    places, angles = ([np.array([row[k][i] for row in rows]).reshape(-1, 3) for i in range(4)] for k in range(2))
    hues: list[tuple[float, str]] = []
    for t_s, cycle in zip(track.t_s, run.cycles, strict=True):
        if cycle.hue and (not hues or hues[-1][1] != cycle.hue):
            hues.append((float(t_s), cycle.hue))
    return FollowEvidence(
        run, quality, verdict, headline, track, is_true, places[0], places[1], places[2], places[3],
        angles[1], angles[2], angles[3], tuple(hues) if len(hues) > 1 else (),
    )  # fmt: skip


def _row(cycle: FollowCycle, station: Pose, is_true: bool) -> tuple[list[FloatArray], list[FloatArray]]:
    """Places (m) and angles (deg) of leader, wanted, true and sensed."""
    leader = cycle.leader if cycle.leader is not None else Pose.identity("world", "beacon")
    known = cycle.leader is not None or not is_true
    poses: list[Pose | None] = [
        leader if known else None,
        leader @ station if known else None,
        cycle.body if cycle.leader is not None else None,
        leader @ cycle.sensed if known and cycle.sensed is not None else None,
    ]
    none = np.full(3, np.nan)
    return (
        [none if pose is None else pose.t_m for pose in poses],
        [none if pose is None else deg_from_rad(np.array(euler_zyx_from_rotation(pose.R))) for pose in poses],
    )
