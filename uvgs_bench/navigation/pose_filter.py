"""A short first-in-first-out memory of relative poses: it refuses outliers and smooths what is left.

A line through the last poses gives pose and velocity at the instant of the newest one. A motion of constant velocity
passes without delay; the velocity is that of the middle of the memory. A pose far from where the line predicts it is
refused, but never for ever: some refused poses in a row that agree with each other replace the memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import so3_exp, so3_log
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.units import s_from_ns

# What every pose is doubted by at least: sensors state their noise, not the faults of their calibration.
_FLOOR_M = 1e-3
_FLOOR_RAD = 2e-3


@dataclass(frozen=True, slots=True)
class PoseFilterConfig:
    """How poses are smoothed and refused.

    Args:
        window: Poses remembered, >= 2; more is smoother, and the velocity later.
        span_s: Poses older than this before the newest are forgotten, s.
        gate: Largest squared Mahalanobis distance from the prediction; 22.46 refuses one good pose of a thousand.
        acceleration_mps2: Relative acceleration the prediction allows for, m/s^2.
        angular_acceleration_radps2: The same for turning, rad/s^2.
        speed_mps: Relative speed it allows for while only one pose is known, m/s.
        rate_radps: The same for turning, rad/s.
        reopen: Refused poses in a row that agree with each other and then replace the memory, >= 2.
        settled: Poses it takes until the result may be used, 2 to ``window``.

    Raises:
        ValueError: A value outside its meaning.
    """

    window: int = 5
    span_s: float = 1.0
    gate: float = 22.46
    acceleration_mps2: float = 0.2
    angular_acceleration_radps2: float = 0.4
    speed_mps: float = 0.5
    rate_radps: float = 1.0
    reopen: int = 3
    settled: int = 3

    def __post_init__(self) -> None:
        if self.window < 2 or self.reopen < 2 or not 2 <= self.settled <= self.window:
            raise ValueError("window and reopen must be at least 2, settled from 2 to window")
        for name in ("span_s", "gate", "acceleration_mps2", "angular_acceleration_radps2", "speed_mps", "rate_radps"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """Where the follower is seen from the leader, with its doubt.

    Args:
        t_ns: Instant of the capture, ns.
        leader_from_body: Pose of the follower's body in the leader's axes (those of its beacon), ``beacon_from_body``.
        covariance: Of rotation vector (body axes, rad) and position (leader's axes, m), shape (6, 6).
    """

    t_ns: int
    leader_from_body: Pose
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PoseMemory:
    """What the filter remembers: hand the answer of one call to the next; empty at first.

    Args:
        kept: Accepted poses, oldest first.
        refused: Refused ones since the last accepted, oldest first.
    """

    kept: tuple[RelativePose, ...] = ()
    refused: tuple[RelativePose, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedPose:
    """The line through the memory at the instant of its newest pose.

    Args:
        t_ns: That instant, ns.
        leader_from_body: The pose, ``beacon_from_body``.
        velocity_mps: Velocity of the follower's origin in the leader's axes, shape (3,), m/s.
        rate_radps: Angular velocity of the follower against the leader, body axes, shape (3,), rad/s.
        count: Poses it rests on.
        velocity_delay_s: How much earlier than ``t_ns`` velocity and rate are valid, s; the pose itself is not late.
        position_sigma_m: Standard deviations of the position by what the sensor states, shape (3,), m.
    """

    t_ns: int
    leader_from_body: Pose
    velocity_mps: FloatArray
    rate_radps: FloatArray
    count: int
    velocity_delay_s: float
    position_sigma_m: FloatArray


def relative_pose(estimate: PoseEstimate, body_from_camera: Pose) -> RelativePose:
    """What a pose of the sensor says about the follower that carries the camera.

    Args:
        estimate: The sensor's pose of the leader's beacon.
        body_from_camera: How the camera sits on the follower.

    Returns:
        The follower seen from the leader. With ``camera_from_beacon <- exp(xi) camera_from_beacon`` it changes on the
        right by ``exp(-Ad(body_from_camera) xi)``, which carries the covariance over.

    Raises:
        FrameMismatch: The frames do not meet.
    """
    leader_from_body = (body_from_camera @ estimate.camera_from_beacon).inverse()
    J = body_from_camera.adjoint()
    J[3:] = leader_from_body.R @ J[3:]
    return RelativePose(estimate.t_ns, leader_from_body, read_only(J @ estimate.covariance @ J.T))


def take_pose(memory: PoseMemory, pose: RelativePose, config: PoseFilterConfig) -> tuple[PoseMemory, bool]:
    """Take a new pose in, or refuse it.

    Args:
        memory: From the last call, ``PoseMemory()`` at first.
        pose: The pose; one that is not newer than the last is refused and forgotten.
        config: The rules.

    Returns:
        The memory for the next call, and whether the pose was accepted (alone, or with those refused before it).
    """
    kept = memory.kept
    if kept and pose.t_ns <= kept[-1].t_ns:
        return memory, False
    kept = tuple(k for k in kept if s_from_ns(pose.t_ns - k.t_ns) <= config.span_s)
    if not kept or _fits(kept, pose, config):
        return PoseMemory((*kept, pose)[-config.window :]), True
    before = memory.refused
    agree = bool(before) and pose.t_ns > before[-1].t_ns and _fits(before, pose, config)
    refused = (*before, pose) if agree else (pose,)
    if len(refused) >= config.reopen:
        return PoseMemory(refused[-config.window :]), True
    return PoseMemory(kept, refused), False


def smoothed(memory: PoseMemory, config: PoseFilterConfig) -> SmoothedPose | None:
    """Pose and velocity at the instant of the newest pose.

    Args:
        memory: The memory.
        config: The rules.

    Returns:
        The line's end; None while fewer than ``settled`` poses are known.
    """
    if len(memory.kept) < config.settled:
        return None
    newest = memory.kept[-1]
    dt_s, turn, place = _table(memory.kept, newest)
    at, rate = line_weights(dt_s)
    R = newest.leader_from_body.R @ so3_exp(at @ turn)
    sigma = np.array([np.diag(k.covariance)[3:] for k in memory.kept])
    return SmoothedPose(
        newest.t_ns,
        Pose(R, at @ place, newest.leader_from_body.target, newest.leader_from_body.source),
        read_only(rate @ place),
        read_only(rate @ turn),
        len(memory.kept),
        -float(np.mean(dt_s)),
        read_only(np.sqrt(at**2 @ sigma)),
    )


def line_weights(dt_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights by which samples give value and slope at time 0 of the straight line of least squares through them.

    Args:
        dt_s: Instants of the samples, shape (n,), s; not all alike.

    Returns:
        Weights of the value, shape (n,), and of the slope, shape (n,), 1/s.
    """
    middle = float(np.mean(dt_s))
    away = dt_s - middle
    slope = away / float(away @ away)
    return 1.0 / len(dt_s) - middle * slope, slope


def _table(kept: tuple[RelativePose, ...], origin: RelativePose) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Instants against ``origin`` (s), rotation vectors against it (body axes, rad), places (leader's axes, m)."""
    dt_s = np.array([s_from_ns(k.t_ns - origin.t_ns) for k in kept])
    R0 = origin.leader_from_body.R
    turn = np.array([so3_log(R0.T @ k.leader_from_body.R) for k in kept])
    return dt_s, turn, np.array([k.leader_from_body.t_m for k in kept])


def _fits(kept: tuple[RelativePose, ...], pose: RelativePose, config: PoseFilterConfig) -> bool:
    """Whether a pose is where the line through the others predicts it."""
    dt_s, turn, place = _table(kept, kept[-1])
    ahead_s = s_from_ns(pose.t_ns - kept[-1].t_ns)
    if len(kept) == 1:
        weights = np.ones(1)
        reach_rad, reach_m = config.rate_radps * ahead_s, config.speed_mps * ahead_s
    else:
        weights, _ = line_weights(dt_s - ahead_s)
        # A line is wrong by half the acceleration times the square of the time it is carried on, and half the window.
        lever_s2 = 0.5 * (ahead_s - 0.5 * float(dt_s[0])) ** 2
        reach_rad, reach_m = config.angular_acceleration_radps2 * lever_s2, config.acceleration_mps2 * lever_s2
    # Against the prediction, in the axes of the covariance: rotation of the body, position in the leader's axes.
    predicted = kept[-1].leader_from_body.R @ so3_exp(weights @ turn)
    off = np.concatenate((so3_log(predicted.T @ pose.leader_from_body.R), pose.leader_from_body.t_m - weights @ place))
    S = pose.covariance + sum(w * w * k.covariance for w, k in zip(weights, kept, strict=True))
    slack_rad, slack_m = np.hypot(_FLOOR_RAD, reach_rad), np.hypot(_FLOOR_M, reach_m)
    S = S + np.diag(np.concatenate((np.full(3, slack_rad**2), np.full(3, slack_m**2))))
    return float(off @ np.linalg.solve(S, off)) <= config.gate
