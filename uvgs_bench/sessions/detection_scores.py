"""Attempts of the detection benchmark held against the truth and summed up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import nan

import numpy as np

from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import rotation_angle
from uvgs_bench.sessions.detection_methods import Attempt
from uvgs_bench.units import rad_from_deg

UVGS, UVGS_ALONE = "uVGS", "uVGS, no sheet in view"
SANE_POSITION_SHARE = 0.05
"""A pose farther off than this share of the range is false."""
SANE_ATTITUDE_RAD = rad_from_deg(10.0)
"""A pose turned by more than this is false, rad."""


@dataclass(frozen=True, slots=True)
class Row:
    """How one method did under one condition (or under all).

    Args:
        method: Its name.
        capture_count: Pictures it was given.
        pose_count: Poses within the sanity limits.
        false_count: Poses outside of them.
        position_rms_m: Root mean square position error of the sane poses, m; NaN without any.
        attitude_rms_rad: Root mean square attitude error of the sane poses, rad; NaN without any.
        time_s: Median processor time per picture, answers and misses alike, s.
        time_p95_s: 95th percentile of the processor time per picture, s.
        wall_s: Median wall-clock time per picture, s.
        position_ratio: Position RMS over that of uVGS, on the pictures where both are sane; NaN without any.
        attitude_ratio: Attitude RMS over that of uVGS, likewise.
        time_ratio: Median time over that of uVGS on the same pictures.
        reasons: Counts of the reasons for no pose.
        stage_s: Median time of each stage, s.
    """

    method: str
    capture_count: int
    pose_count: int
    false_count: int
    position_rms_m: float
    attitude_rms_rad: float
    time_s: float
    time_p95_s: float
    wall_s: float
    position_ratio: float
    attitude_ratio: float
    time_ratio: float
    reasons: dict[str, int] = field(default_factory=dict)
    stage_s: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Score:
    """One attempt against the truth.

    Args:
        position_error_m: Distance of the target's origin from its true place, m; NaN without a pose.
        attitude_error_rad: Angle from the true attitude, rad; NaN without a pose.
        is_sane: Whether there is a pose within the sanity limits.
        is_false: Whether there is a pose outside of them.
        attempt: The attempt.
    """

    position_error_m: float
    attitude_error_rad: float
    is_sane: bool
    is_false: bool
    attempt: Attempt


# Scores by method; each in the order of the pictures, keyed by family and capture so that methods can be paired.
Scores = dict[str, dict[tuple[str, int], Score]]


def score(attempt: Attempt, true: Pose, range_m: float) -> Score:
    """Hold an attempt against the truth.

    Args:
        attempt: The attempt.
        true: True pose of the target.
        range_m: Its true distance, m.
    """
    if attempt.pose is None:
        return Score(nan, nan, False, False, attempt)
    position_m = float(np.linalg.norm(attempt.pose.t_m - true.t_m))
    attitude_rad = rotation_angle(attempt.pose.R @ true.R.T)
    is_sane = position_m <= SANE_POSITION_SHARE * range_m and attitude_rad <= SANE_ATTITUDE_RAD
    return Score(position_m, attitude_rad, is_sane, not is_sane, attempt)


def row_of(name: str, scores: Scores) -> Row:
    """Sum up the scores of one method; ratios are to uVGS on the same pictures."""
    own = scores[name]
    yardstick = scores[UVGS_ALONE if name == UVGS_ALONE else UVGS]
    all_own = list(own.values())
    sane = [s for s in all_own if s.is_sane]
    paired = [(s, yardstick[key]) for key, s in own.items() if s.is_sane and yardstick[key].is_sane]
    times = np.array([s.attempt.duration_s for s in all_own])
    other = np.array([yardstick[key].attempt.duration_s for key in own])
    stages = sorted({stage for s in all_own for stage in s.attempt.stage_s})

    def ratio(of: Callable[[Score], float]) -> float:
        return _rms([of(a) for a, _ in paired]) / _rms([of(b) for _, b in paired])

    return Row(
        method=name,
        capture_count=len(all_own),
        pose_count=len(sane),
        false_count=sum(s.is_false for s in all_own),
        position_rms_m=_rms([s.position_error_m for s in sane]),
        attitude_rms_rad=_rms([s.attitude_error_rad for s in sane]),
        time_s=float(np.median(times)),
        time_p95_s=float(np.quantile(times, 0.95)),
        wall_s=float(np.median([s.attempt.wall_s for s in all_own])),
        position_ratio=ratio(lambda s: s.position_error_m),
        attitude_ratio=ratio(lambda s: s.attitude_error_rad),
        time_ratio=float(np.median(times) / np.median(other)),
        reasons=dict(Counter(s.attempt.reason for s in all_own if s.attempt.reason).most_common()),
        stage_s={stage: float(np.median([s.attempt.stage_s.get(stage, 0.0) for s in all_own])) for stage in stages},
    )


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else nan
