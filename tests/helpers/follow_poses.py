"""Poses for tests of following: made of numbers, without pictures."""

from __future__ import annotations

import numpy as np

from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.navigation.pose_filter import RelativePose
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.units import ns_from_s


def relative(
    t_s: float, place_m: object = (0.0, 0.0, 0.0), turn_rad: object = (0.0, 0.0, 0.0), sigma: float = 1e-3
) -> RelativePose:
    """A follower at a place with an attitude, and the same doubt in every direction."""
    pose = Pose.exp(np.concatenate((np.asarray(turn_rad, dtype=np.float64), np.zeros(3))), "beacon", "body")
    place = np.asarray(place_m, dtype=np.float64)
    return RelativePose(ns_from_s(t_s), Pose(pose.R, place, "beacon", "body"), np.eye(6) * sigma**2)


def estimate(
    camera_from_beacon: Pose, t_ns: int, covariance: FloatArray | None = None, beacon: str = "b"
) -> PoseEstimate:
    """What the sensor would say of a pose."""
    spread = np.eye(6) * 1e-8 if covariance is None else covariance
    px = np.zeros((4, 2))
    return PoseEstimate(camera_from_beacon, spread, t_ns, beacon, px, px, 0.1, 10.0, 4)
