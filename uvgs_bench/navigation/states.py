"""Where a body is, how it moves, what its unit's biases are, and how sure all of that is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import hat, so3_log
from uvgs_bench.sensor.outcome import PoseEstimate


@dataclass(frozen=True, slots=True, eq=False)
class NavigationState:
    """A body at one instant.

    Args:
        t_ns: The instant, ns.
        world_from_body: Its pose.
        velocity_mps: Velocity of the body's origin in world axes, shape (3,), m/s.
        acceleration_bias_mps2: Bias of the accelerometers, shape (3,), m/s^2.
        rate_bias_radps: Bias of the gyroscopes, shape (3,), rad/s.
        covariance: Covariance of the errors of position (m), velocity (m/s), rotation (left, in world axes, rad),
            accelerometer bias and gyroscope bias, in this order, shape (15, 15).
    """

    t_ns: int
    world_from_body: Pose
    velocity_mps: FloatArray
    acceleration_bias_mps2: FloatArray
    rate_bias_radps: FloatArray
    covariance: FloatArray

    @property
    def position_sigma_m(self) -> FloatArray:
        """Standard deviations of the position along the world's axes, shape (3,), m."""
        return np.sqrt(np.diag(self.covariance)[:3])

    @property
    def rotation_sigma_rad(self) -> FloatArray:
        """Standard deviations of the rotation about the world's axes, shape (3,), rad."""
        return np.sqrt(np.diag(self.covariance)[6:9])

    @property
    def place_covariance(self) -> FloatArray:
        """Covariance of rotation (left, world axes, rad), then position (m), shape (6, 6)."""
        rows = np.array([6, 7, 8, 0, 1, 2])
        return read_only(self.covariance[np.ix_(rows, rows)])

    def error_of(self, world_from_body: Pose, velocity_mps: FloatArray) -> FloatArray:
        """Truth minus this state in the first nine errors: position, velocity, rotation, shape (9,)."""
        turn = so3_log(np.ascontiguousarray(world_from_body.R @ self.world_from_body.R.T))
        return np.concatenate((world_from_body.t_m - self.world_from_body.t_m, velocity_mps - self.velocity_mps, turn))


@dataclass(frozen=True, slots=True, eq=False)
class PoseMeasurement:
    """A measured pose of the body.

    Args:
        t_ns: The instant it holds for, ns.
        world_from_body: The pose.
        covariance: Covariance of rotation (left, in world axes, rad), then position of the body (m), shape (6, 6).
        source: Who measured it: ``uvgs``, ``native``.
        delay_ns: How long after that instant it was known, ns.
    """

    t_ns: int
    world_from_body: Pose
    covariance: FloatArray
    source: str = "uvgs"
    delay_ns: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", read_only(self.covariance, (6, 6)))


def place_from_tangent(pose: Pose, covariance: FloatArray) -> FloatArray:
    """Covariance of (rotation, position) from that of the left tangent vector (omega, v).

    The tangent's v is not the change of the position: under the left update ``dt = v + omega x t``.

    Args:
        pose: The pose the tangent belongs to.
        covariance: Shape (6, 6), rad and m.

    Returns:
        Shape (6, 6), rad and m, axes of the pose's target.
    """
    A = np.eye(6)
    A[3:, :3] = -hat(pose.t_m)
    result: FloatArray = A @ covariance @ A.T
    return result


def tangent_from_place(pose: Pose, covariance: FloatArray) -> FloatArray:
    """The inverse of ``place_from_tangent``."""
    A = np.eye(6)
    A[3:, :3] = hat(pose.t_m)
    result: FloatArray = A @ covariance @ A.T
    return result


@dataclass(frozen=True, slots=True, eq=False)
class SensedPose:
    """A pose of the sensor with what fusion needs of it.

    Args:
        t_ns: Instant of the capture, ns.
        camera_from_beacon: The pose.
        covariance: Covariance of the left tangent vector (omega, v) in camera axes, shape (6, 6), rad and m.
        delay_ns: How long after its capture it was known, ns.
        led_px: Centres in the order of the beacon's LEDs, shape (n, 2), raw px, NaN if unseen; None when not recorded.
        noise_covariance: The part of ``covariance`` that is drawn anew in every capture; the rest, of lens and beacon,
            is the same in every capture. None when that is not known.
    """

    t_ns: int
    camera_from_beacon: Pose
    covariance: FloatArray
    delay_ns: int = 0
    led_px: FloatArray | None = None
    noise_covariance: FloatArray | None = None

    @classmethod
    def of(cls, estimate: PoseEstimate, delay_ns: int = 0) -> SensedPose:
        """All an estimate says about one pose, known a delay after its capture."""
        total, noise = read_only(estimate.total_covariance), read_only(estimate.noise_covariance)
        return cls(estimate.t_ns, estimate.camera_from_beacon, total, delay_ns, estimate.led_px, noise)

    @property
    def led_count(self) -> int:
        """How many LEDs it stands on; 4 when not recorded."""
        return 4 if self.led_px is None else int(np.isfinite(self.led_px).all(axis=1).sum())


def body_measurement(
    sensed: SensedPose,
    world_from_beacon: Pose,
    body_from_camera: Pose,
    *,
    sigma_floor_m: float = 0.0,
    sigma_floor_rad: float = 0.0,
) -> PoseMeasurement:
    """What a pose of the sensor says about the body that carries the camera.

    Args:
        sensed: The sensor's pose.
        world_from_beacon: Where the beacon stands.
        body_from_camera: How the camera sits on the body.
        sigma_floor_m: Deviation added to the position along each axis, m: what the sensor cannot know of.
        sigma_floor_rad: Deviation added to the rotation about each axis, rad.

    Returns:
        The measurement.
    """
    world_from_camera = world_from_beacon @ sensed.camera_from_beacon.inverse()
    world_from_body = world_from_camera @ body_from_camera.inverse()
    # exp(xi) on the sensor's pose is exp(-Ad xi) on the body's.
    Ad = world_from_camera.adjoint()
    covariance = place_from_tangent(world_from_body, Ad @ sensed.covariance @ Ad.T)
    covariance[np.diag_indices(6)] += np.repeat((sigma_floor_rad**2, sigma_floor_m**2), 3)
    return PoseMeasurement(sensed.t_ns, world_from_body, 0.5 * (covariance + covariance.T), "uvgs", sensed.delay_ns)
