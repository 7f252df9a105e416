"""What of the set-up does not fit the data: clocks of sensor and inertial unit, or how the camera is mounted.

A filter whose inputs fit together is surprised by noise alone. The offset and the mounting are found that leave the
least surprise, with the doubt that remains; a motion that does not tell them leaves a large doubt, and is said so.
Nothing is corrected here.

Source: maximum likelihood by the innovations of a filter, R. K. Mehra, 1970; solved by Gauss-Newton steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.navigation.error_state_filter import POSE_ROWS, FilterConfig, packed, start_state
from uvgs_bench.navigation.filter_kernels import (
    correct,
    innovation_covariance,
    pose_residual,
    propagate_steps,
)
from uvgs_bench.navigation.imu import ImuSamples
from uvgs_bench.navigation.states import PoseMeasurement, SensedPose, body_measurement
from uvgs_bench.units import ns_from_s, s_from_ns

_SCAN_S = (-0.4, -0.2, -0.1, 0.0, 0.1, 0.2, 0.4)
_STEPS = np.array([2e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3])
_ROUNDS = 5
# With less surprise than this the clocks are so near that no far offset need be tried.
_SCANNED = 1.5
# Innovations of six numbers longer than this weigh less: false poses must not lead.
_FAR = 4.0
# More poses than these say nothing new about seven numbers.
_MOST_POSES = 400
# A pose farther than this from the median of five, and than so many usual distances, is a stray.
_STRAY_M, _STRAY_MEDIANS = 0.02, 10.0
# Over a longer time without a pose the filter is not followed, s.
_PAUSE_S = 1.0
# Beyond these a found number is none: the data did not hold it, s, rad, m.
_FARTHEST = np.array([0.6, 0.5, 0.5, 0.5, 1.0, 1.0, 1.0])
# What may be told is told only when its doubt is below this: s, rad, m.
_KNOWN = np.array([0.02, 0.01, 0.01, 0.01, 0.02, 0.02, 0.02])


@dataclass(frozen=True, slots=True, eq=False)
class Misfit:
    """How the set-up would have to differ for the data to fit.

    Args:
        offset_s: By how much the sensor's stamps are too late against those of the inertial unit, s.
        rotation_rad: Rotation vector the camera is turned by against its stated mounting, its own axes, shape (3,).
        shift_m: How far it is moved against its stated mounting, its own axes, shape (3,), m.
        sigma: Standard deviations of the seven numbers in this order, shape (7,), s, rad, m.
        is_known: Which of the seven this motion tells, shape (7,).
        surprise_before: Mean squared innovation of the data as stated, per number; 1 is expected.
        surprise_after: The same with the seven numbers put right.
    """

    offset_s: float
    rotation_rad: FloatArray
    shift_m: FloatArray
    sigma: FloatArray
    is_known: tuple[bool, ...]
    surprise_before: float
    surprise_after: float


def find_misfit(
    imu: ImuSamples,
    sensed: Sequence[SensedPose],
    world_from_beacon: Pose,
    body_from_camera: Pose,
    config: FilterConfig,
) -> Misfit | None:
    """Find what of the set-up does not fit.

    Args:
        imu: Readings.
        sensed: Poses of the sensor, in order.
        world_from_beacon: Where the beacon stands, as stated.
        body_from_camera: How the camera sits, as stated.
        config: Noise and gravity.

    Returns:
        The misfit, or None with too little data: fewer than 20 poses, or not enough readings beside them.
    """
    inside = [pose for pose in sensed if imu.t_ns[0] < pose.t_ns < imu.t_ns[-1]] if len(imu) > 1 else []
    inside = _without_strays(inside)
    if len(inside) < 20:
        return None
    poses = inside[:_MOST_POSES]
    readings = imu.between(poses[0].t_ns - ns_from_s(1.0), poses[-1].t_ns + ns_from_s(1.0))

    def surprise(x: FloatArray) -> FloatArray:
        camera = body_from_camera @ Pose.exp(x[1:], "camera", "camera")
        moved = [replace(pose, t_ns=pose.t_ns - ns_from_s(float(x[0]))) for pose in poses]
        return _innovations(readings, moved, world_from_beacon, camera, config)

    nothing = surprise(np.zeros(7))
    x, e = np.zeros(7), nothing
    if float(np.mean(_weights(e)[:, None] * e**2)) > _SCANNED:
        starts = [np.concatenate(([offset_s], np.zeros(6))) for offset_s in _SCAN_S]
        x, e = min(((start, surprise(start)) for start in starts), key=lambda tried: _cost(tried[1]))
    normal = np.eye(7)
    for _ in range(_ROUNDS):
        J = np.stack([(surprise(x + step) - e).reshape(-1) for step in np.diag(_STEPS)], axis=1) / _STEPS
        w = np.repeat(_weights(e), 6)
        normal = J.T @ (w[:, None] * J)
        move = -np.linalg.lstsq(normal, J.T @ (w * e.reshape(-1)), rcond=1e-12)[0]
        tried = surprise(x + move)
        if _cost(tried) > _cost(e):
            break
        x, e = x + move, tried
        if (np.abs(move) < 0.1 * np.sqrt(np.diag(np.linalg.pinv(normal, rcond=1e-14)))).all():
            break
    after = float(np.mean(_weights(e)[:, None] * e**2))
    # What cannot be explained makes the doubt larger, as in any fit.
    sigma = np.sqrt(np.diag(np.linalg.pinv(normal, rcond=1e-14)) * max(after, 1.0))
    return Misfit(
        offset_s=float(x[0]),
        rotation_rad=read_only(x[1:4]),
        shift_m=read_only(x[4:]),
        sigma=read_only(sigma),
        is_known=tuple(bool(known) for known in (sigma < _KNOWN) & bool((np.abs(x) < _FARTHEST).all())),
        surprise_before=float(np.mean(_weights(nothing)[:, None] * nothing**2)),
        surprise_after=after,
    )


def _without_strays(poses: Sequence[SensedPose]) -> list[SensedPose]:
    """Poses without those that stand far from both their neighbours, as false ones do."""
    if len(poses) < 5:
        return list(poses)
    place = np.array([pose.camera_from_beacon.inverse().t_m for pose in poses])
    padded = np.pad(place, ((2, 2), (0, 0)), mode="edge")
    middle = np.median(np.stack([padded[k : k + len(place)] for k in range(5)]), axis=0)
    off = np.linalg.norm(place - middle, axis=1)
    limit = max(_STRAY_M, _STRAY_MEDIANS * float(np.median(off)))
    return [pose for pose, far in zip(poses, off > limit, strict=True) if not far]


def _weights(e: FloatArray) -> FloatArray:
    out: FloatArray = np.minimum(1.0, _FAR / np.maximum(np.linalg.norm(e, axis=1), 1e-12))
    return out


def _cost(e: FloatArray) -> float:
    length = np.linalg.norm(e, axis=1)
    return float(np.where(length < _FAR, 0.5 * length**2, _FAR * (length - 0.5 * _FAR)).sum())


def _begun_anew(m: PoseMeasurement, state: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A state at a measured pose with the biases of another one."""
    fresh = start_state(m, acceleration_bias_mps2=state[15:18], rate_bias_radps=state[18:21])
    covariance = np.array(fresh.covariance)
    covariance[9:, 9:] = P[9:, 9:]
    return packed(fresh), covariance


def _innovations(
    imu: ImuSamples, poses: Sequence[SensedPose], world_from_beacon: Pose, body_from_camera: Pose, config: FilterConfig
) -> FloatArray:
    """Innovations of a filter without a gate, each in units of what was expected of it, shape (n, 6)."""
    noise, gravity = config.noise.vector(), read_only(config.gravity_mps2)
    measured = [body_measurement(pose, world_from_beacon, body_from_camera) for pose in poses]
    start = start_state(measured[0])
    state, P = packed(start), np.array(start.covariance)
    readings = np.hstack((imu.acceleration_mps2, imu.rate_radps))
    means = 0.5 * (readings[1:] + readings[:-1])
    k = max(int(np.searchsorted(imu.t_ns, start.t_ns, side="right")), 1)
    now_ns, out = start.t_ns, np.empty((len(poses) - 1, 6))
    for row, m in zip(out, measured[1:], strict=True):
        if s_from_ns(m.t_ns - now_ns) > _PAUSE_S:
            # Too long to be carried through: it begins anew, with the biases as they are.
            state, P, now_ns = *_begun_anew(m, state, P), m.t_ns
            k = max(int(np.searchsorted(imu.t_ns, now_ns, side="right")), 1)
            row[:] = 0.0
            continue
        last = max(int(np.searchsorted(imu.t_ns, m.t_ns)), k)
        ends = np.concatenate(([now_ns], imu.t_ns[k:last], [m.t_ns]))
        steps = np.minimum(np.arange(k, last + 1), len(imu) - 1) - 1
        propagate_steps(state, P, means[steps], np.diff(ends) / 1e9, noise, gravity)
        now_ns, k = m.t_ns, max(int(np.searchsorted(imu.t_ns, m.t_ns, side="right")), 1)
        residual = pose_residual(state, m.world_from_body.R, m.world_from_body.t_m)
        L, distance = innovation_covariance(P, m.covariance, POSE_ROWS, residual)
        row[:] = np.linalg.solve(L, residual)
        # A far-off pose takes part with the weight it has in the fit.
        widened = read_only(m.covariance * max(1.0, np.sqrt(distance) / _FAR) ** 2)
        if distance > _FAR**2:
            L, _ = innovation_covariance(P, widened, POSE_ROWS, residual)
        correct(state, P, L, widened, POSE_ROWS, residual)
    return out
