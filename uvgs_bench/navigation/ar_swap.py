"""Pose-only fusion: the sensor in the place of AR tags in Astrobee's localiser, with that localiser's gates.

No inertial unit takes part: between poses the body is taken to keep its velocity, over at most one second. Where the
beacon stands in the world is learned once, from the first pose that is accepted, as the localiser does; what is wrong
with that one pose stays. Poses of map landmarks are used beside those of the beacon, or only when there are none.

Source: nasa/astrobee, localization settings and AR branch of the graph localiser.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import so3_exp, so3_log
from uvgs_bench.navigation.states import PoseMeasurement, SensedPose
from uvgs_bench.units import s_from_ns

_ROUNDS = 4
# A body that keeps its velocity for t may still be off by half this times t squared, m/s^2 and rad/s^2.
_UNKNOWN_ACCELERATION_MPS2 = 0.1
_UNKNOWN_ANGULAR_RADPS2 = 0.1

Reason = Literal["fused", "too_few_matches", "reprojection", "frame_unknown", "not_mixed"]


@dataclass(frozen=True, slots=True)
class AstroLocSettings:
    """Numbers of Astrobee's localiser.

    Args:
        min_num_matches: Fewest LEDs of a message; the shipped 5 drops every beacon of four, silently.
        max_reprojection_px: Largest reprojection error of a message at the pose it was expected at, px.
        prior_sigma_m: Deviation a pose is given per axis, m, whoever measured it.
        prior_sigma_rad: The same for the rotation: 0.06 of the quaternion's vector, rad.
        huber_k: Where residuals begin to weigh less, in deviations.
        max_states: Most poses looked at together.
        timeout_s: A source that is silent for longer is gone; also how far poses are carried on, s.
        stale_s: The beacon is not learned from a native pose older than this, s.
        is_mixed: Whether native poses are used while the beacon is seen.
    """

    min_num_matches: int = 4
    max_reprojection_px: float = 30.0
    prior_sigma_m: float = 0.06
    prior_sigma_rad: float = 0.12
    huber_k: float = 1.345
    max_states: int = 5
    timeout_s: float = 1.0
    stale_s: float = 0.5
    is_mixed: bool = True

    def __post_init__(self) -> None:
        if self.min_num_matches < 3 or self.max_states < 1:
            raise ValueError("min_num_matches must be at least 3 and max_states at least 1")
        positive = ("max_reprojection_px", "prior_sigma_m", "prior_sigma_rad", "huber_k", "timeout_s", "stale_s")
        for name in positive:
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, eq=False)
class SwapState:
    """What the localiser says at an instant.

    Args:
        t_ns: The instant, ns.
        world_from_body: Its pose.
        velocity_mps: Velocity in world axes, shape (3,), m/s.
        covariance: Covariance of rotation (left, world axes, rad), then position (m), shape (6, 6).
        age_s: How old the newest pose behind it is, s.
    """

    t_ns: int
    world_from_body: Pose
    velocity_mps: FloatArray
    covariance: FloatArray
    age_s: float


class ArSwap:
    """A pose-only localiser.

    Args:
        body_from_camera: How the camera sits on the body.
        leds_m: LED positions in the beacon frame, shape (n, 3), m: what is reprojected.
        focal_px: Focal length the reprojection is measured with, px.
        world_from_beacon: Where the beacon stands when that is known; None learns it from the first message.
        settings: The localiser's numbers.
    """

    def __init__(
        self,
        body_from_camera: Pose,
        leds_m: FloatArray,
        focal_px: float,
        world_from_beacon: Pose | None = None,
        settings: AstroLocSettings | None = None,
    ) -> None:
        self.settings = AstroLocSettings() if settings is None else settings
        self.world_from_beacon = world_from_beacon
        self._body_from_camera = body_from_camera
        self._leds_m = read_only(leds_m, (-1, 3))
        self._focal_px = focal_px
        self._window: list[PoseMeasurement] = []
        self._seen_ns: int | None = None

    def add_sensed(self, sensed: SensedPose) -> Reason:
        """Take a pose of the sensor, or say why not."""
        if sensed.led_count < self.settings.min_num_matches:
            return "too_few_matches"
        body_from_beacon = self._body_from_camera @ sensed.camera_from_beacon
        if self.world_from_beacon is None:
            now = self.state_at(sensed.t_ns)
            if now is None or now.age_s > self.settings.stale_s:
                return "frame_unknown"
            self.world_from_beacon = now.world_from_body @ body_from_beacon
        elif self._reprojection_px(sensed) > self.settings.max_reprojection_px:
            return "reprojection"
        self._seen_ns = sensed.t_ns
        self._add(sensed.t_ns, self.world_from_beacon @ body_from_beacon.inverse(), "uvgs")
        return "fused"

    def add_native(self, measurement: PoseMeasurement) -> Reason:
        """Take a pose of the native localiser, or say why not."""
        seen = self._seen_ns
        is_seen = seen is not None and s_from_ns(measurement.t_ns - seen) <= self.settings.timeout_s
        if is_seen and not self.settings.is_mixed:
            return "not_mixed"
        self._add(measurement.t_ns, measurement.world_from_body, "native")
        return "fused"

    def state_at(self, t_ns: int) -> SwapState | None:
        """The pose at an instant; None when no pose is younger than the timeout.

        The poses of the last second are fitted with one velocity, far ones weighing less.
        """
        s = self.settings
        recent = [m for m in self._window if 0.0 <= s_from_ns(t_ns - m.t_ns) <= s.timeout_s]
        if not recent:
            return None
        anchor = recent[-1].world_from_body
        ages = np.array([s_from_ns(m.t_ns - t_ns) for m in recent])
        rows = np.array([_from_anchor(anchor, m.world_from_body) for m in recent])
        sigma = np.repeat((s.prior_sigma_rad, s.prior_sigma_m), 3)
        is_moving = len(recent) > 1
        A = np.column_stack((np.ones(len(recent)), ages)) if is_moving else np.ones((len(recent), 1))
        weight = np.ones(len(recent))
        x, normal = np.zeros((A.shape[1], 6)), np.eye(A.shape[1])
        for _ in range(_ROUNDS):
            normal = A.T @ (weight[:, None] * A)
            x = np.linalg.solve(normal, A.T @ (weight[:, None] * rows))
            size = np.linalg.norm((rows - A @ x) / sigma, axis=1)
            weight = np.minimum(1.0, s.huber_k / np.maximum(size, 1e-12))
        age_s = float(-ages[-1])
        spread = np.linalg.inv(normal)[0, 0] * sigma**2
        unknown = np.repeat((_UNKNOWN_ANGULAR_RADPS2, _UNKNOWN_ACCELERATION_MPS2), 3)
        covariance = np.diag(spread + (0.5 * unknown * age_s**2) ** 2)
        R = so3_exp(np.ascontiguousarray(x[0, :3])) @ anchor.R
        pose = Pose(R, anchor.t_m + x[0, 3:], "world", "body")
        velocity = x[1, 3:] if is_moving else np.zeros(3)
        return SwapState(t_ns, pose, read_only(velocity), read_only(covariance), age_s)

    def _add(self, t_ns: int, world_from_body: Pose, source: str) -> None:
        sigma = np.repeat((self.settings.prior_sigma_rad, self.settings.prior_sigma_m), 3)
        self._window.append(PoseMeasurement(t_ns, world_from_body, np.diag(sigma**2), source))
        self._window.sort(key=lambda m: m.t_ns)
        del self._window[: -self.settings.max_states]

    def _reprojection_px(self, sensed: SensedPose) -> float:
        """RMS distance in the picture between LEDs as sensed and as expected; 0 when nothing is expected."""
        now = self.state_at(sensed.t_ns)
        if now is None or self.world_from_beacon is None:
            return 0.0
        expected = (now.world_from_body @ self._body_from_camera).inverse() @ self.world_from_beacon
        places = []
        for pose in (sensed.camera_from_beacon, expected):
            points = pose.apply(self._leds_m)
            if float(points[:, 2].min()) <= 0.0:
                return np.inf
            places.append(self._focal_px * points[:, :2] / points[:, 2:])
        return float(np.sqrt(np.mean(np.sum((places[0] - places[1]) ** 2, axis=1))))


def _from_anchor(anchor: Pose, pose: Pose) -> FloatArray:
    turn = so3_log(np.ascontiguousarray(pose.R @ anchor.R.T))
    return np.concatenate((turn, pose.t_m - anchor.t_m))
