"""What the sensor answers: a pose with its doubt, or the reason why there is none."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from uvgs_bench.geometry import FloatArray, Pose


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """One solved pose.

    Args:
        camera_from_beacon: The pose.
        covariance: Covariance of the left tangent vector (omega, v) in camera axes, shape (6, 6), rad and m: what the
            noise of this capture and the doubt about the LED positions make together.
        t_ns: Instant of the capture, ns.
        beacon: Name of the beacon.
        led_px: Observed centres in the order of the beacon's LEDs, shape (n, 2), raw (distorted) px, freed of the
            perspective of the LEDs' discs; NaN if unseen.
        residual_px: Observed minus projected, same shape, px.
        rms_px: Root mean square of the residual components, per axis, px.
        margin: How much better than the runner-up, ratio of costs, >= 1; inf when there is no runner-up.
        blob_count: Number of candidate blobs after selection.
        runner_up: The best truly different pose, or None.
        stage_s: Duration of each stage, s, by stage name.
        flags: What a user should know: ``weak_evidence`` (chance could fit as well had an LED been hidden and a glint
            stood in its stead), ``three_leds_with_prior`` (no redundancy; the prior is fused into the pose).
        beacon_covariance: The part of ``covariance`` from the LED positions; it is the same error in every capture.
            None when the beacon states no covariance.
        calibration_covariance: What the doubt about the lens adds, not part of ``covariance``: it is the same error in
            every capture, and a registration fitted through the same lens takes up most of it. None when the
            calibration states no covariance.
        tracked_count: How many captures in a row were solved from windows around the prior; 0: the whole picture.
    """

    camera_from_beacon: Pose
    covariance: FloatArray
    t_ns: int
    beacon: str
    led_px: FloatArray
    residual_px: FloatArray
    rms_px: float
    margin: float
    blob_count: int
    runner_up: Pose | None = None
    stage_s: dict[str, float] = field(default_factory=dict)
    flags: tuple[str, ...] = ()
    beacon_covariance: FloatArray | None = None
    calibration_covariance: FloatArray | None = None
    tracked_count: int = 0

    @property
    def noise_covariance(self) -> FloatArray:
        """The part of ``covariance`` that is drawn anew in every capture, shape (6, 6)."""
        return self.covariance if self.beacon_covariance is None else self.covariance - self.beacon_covariance

    @property
    def total_covariance(self) -> FloatArray:
        """Everything stated about this one pose: noise, LED positions and lens, shape (6, 6)."""
        lens = self.calibration_covariance
        return self.covariance if lens is None else self.covariance + lens

    @property
    def position_covariance_m2(self) -> FloatArray:
        """Covariance of the translation itself in camera axes, shape (3, 3), m^2.

        The tangent's v is not the change of t: under the left update ``dt = v + omega x t``.
        """
        x, y, z = self.camera_from_beacon.t_m
        A = np.zeros((3, 6))
        A[:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        A[:, 3:] = np.eye(3)
        result: FloatArray = A @ self.covariance @ A.T
        return result

    @property
    def position_sigma_m(self) -> FloatArray:
        """Standard deviations of the translation along the camera's x, y, z, shape (3,), m."""
        return np.sqrt(np.diag(self.position_covariance_m2))

    @property
    def rotation_sigma_rad(self) -> FloatArray:
        """Standard deviations of the rotation vector about the camera's x, y, z, shape (3,), rad."""
        return np.sqrt(np.diag(self.covariance)[:3])


@dataclass(frozen=True, slots=True, eq=False)
class Miss:
    """No pose, and why.

    Args:
        stage: Where it stopped: ``preprocess``, ``blobs``, ``selection``, ``correspondence``, ``solve``, ``validate``.
        reason: A short, stable word for tables, for example ``too_few_blobs``.
        detail: One line for people, with the numbers.
        t_ns: Instant of the capture, ns.
        beacon: Name of the beacon.
        blob_count: Number of candidate blobs when it stopped.
        stage_s: Duration of each stage, s, by stage name.
        led_px: Centres of the LEDs of a fit that was refused, in the order of the beacon's LEDs, shape (n, 2), px; NaN
            if unseen. None when none were named.
    """

    stage: str
    reason: str
    detail: str
    t_ns: int
    beacon: str
    blob_count: int = 0
    stage_s: dict[str, float] = field(default_factory=dict)
    led_px: FloatArray | None = None


Outcome = PoseEstimate | Miss
