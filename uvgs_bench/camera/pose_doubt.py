"""How far a pose is off because of the calibration, and how far because of the noise of one picture.

The first part is the same in every picture taken at that place: averaging does not help. It is told apart from the
noise for that reason. The frame is that of the camera as the boards saw it: what lens and boards share is no error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray, Pose

FORECAST_RANGES_M = (0.5, 1.0, 2.0, 4.0)
"""Ranges a calibration is forecast at, m."""

LED_NOISE_PX = 0.05
"""Of a bright LED's centre in one coordinate of one picture, px."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseDoubt:
    """Covariances of attitude (rad) and position of the target's origin (m), camera axes, shape (6, 6) each.

    Args:
        by_calibration: What one calibration does to every picture.
        by_noise: What the noise of the points does to one picture.
    """

    by_calibration: FloatArray
    by_noise: FloatArray

    @property
    def calibration_sigmas(self) -> FloatArray:
        """Deviations by the calibration: three angles (rad), then x, y, z (m), shape (6,)."""
        return np.sqrt(np.diag(self.by_calibration))

    @property
    def noise_sigmas(self) -> FloatArray:
        """Deviations by the noise: three angles (rad), then x, y, z (m), shape (6,)."""
        return np.sqrt(np.diag(self.by_noise))


def pose_doubt(calibration: Calibration, points_m: ArrayLike, camera_from_target: Pose, noise_px: float) -> PoseDoubt:
    """Carry the covariance of a calibration and the noise of points into the pose fitted to them.

    Args:
        calibration: With ``joint_covariance``.
        points_m: Points of the target, target frame, shape (N, 3), m; at least four, all in the picture's valid field.
        camera_from_target: Pose of the target.
        noise_px: Standard deviation of each coordinate of a point, px.

    Returns:
        Both parts.

    Raises:
        CalibrationError: The calibration has no joint covariance, or the lens does not see the points.
    """
    joint = calibration.joint_covariance
    if joint is None:
        raise CalibrationError("the calibration does not say how sure it is of its projection: calibrate again")
    seen_m = camera_from_target.apply(np.asarray(points_m, dtype=np.float64))
    px, by_point, by_lens = calibration.lens.project_with_jacobians(seen_m)
    if not np.isfinite(px).all():
        raise CalibrationError("the lens does not see all points at this pose")
    by_pose = np.concatenate([np.cross(seen_m[:, None, :], by_point), by_point], axis=2).reshape(-1, 6)
    # A least-squares pose follows a change of the lens by -pinv(by_pose) @ by_lens, and the mean twist of the boards as
    # it is; both move with the camera's frame and are opposite to the error.
    inverse = np.linalg.pinv(by_pose)
    follow = np.concatenate([inverse @ by_lens.reshape(len(by_pose), -1), np.eye(6)], axis=1)
    # From a left twist to attitude and the place of the target's origin: dt = v + omega x t.
    x, y, z = camera_from_target.t_m
    place = np.eye(6)
    place[3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    by_calibration = place @ follow @ joint @ follow.T @ place.T
    by_noise = noise_px**2 * place @ inverse @ inverse.T @ place.T
    return PoseDoubt(by_calibration, by_noise)


def doubt_ahead(calibration: Calibration, points_m: ArrayLike, range_m: float) -> PoseDoubt | None:
    """The same for a target on the optical axis that faces the camera, its points as noisy as LEDs.

    Args:
        calibration: With ``joint_covariance``.
        points_m: Points of the target, target frame, shape (N, 3), m.
        range_m: Distance of its origin, m.

    Returns:
        Both parts; None when a point lies outside the picture.

    Raises:
        CalibrationError: The calibration has no joint covariance.
    """
    pose = Pose(np.eye(3), np.array([0.0, 0.0, range_m]), "camera", "beacon")
    px = calibration.lens.project(pose.apply(points_m))
    if not np.isfinite(px).all() or not calibration.lens.contains(px).all():
        return None
    return pose_doubt(calibration, points_m, pose, LED_NOISE_PX)
