"""A beacon that passes before a camera on a smooth seeded path: something to see without a gantry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.sim.bench import displaced_beacon, true_lens
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.geometry import Pose
from uvgs_bench.geometry.se3 import rotation_from_euler_zyx
from uvgs_bench.units import rad_from_deg, s_from_ns

# Middle and half range of the path: distance m; share of the half picture; angle about each axis, deg.
_DISTANCE_M = (0.9, 0.25)
_PICTURE_SHARE = 0.6
_ANGLE_DEG = 12.0
# How far beside the beacon the first companion rides, m.
_BESIDE_M = 0.22
# Slowest and fastest swing, Hz; a swing of 0.1 Hz moves an LED by some px between captures.
_SWING_HZ = (0.03, 0.11)


class PassingBeacon:
    """A scene for the simulated camera: six independent sine swings of position and attitude (a Lissajous path).

    Args:
        truth: What is true; gantry and carriage stand still at machine zero.
        beacon: The beacon as its file says.
        seed: Seed of path and noise in place of the truth's.
        companions: Further beacons that ride beside it, to its right and left in turn.

    Raises:
        ConfigError: The truth does not fit the beacon, or its lens is impossible.
    """

    def __init__(
        self, truth: SimulatedTruth, beacon: Beacon, seed: int | None = None, companions: Sequence[Beacon] = ()
    ) -> None:
        self.truth = truth
        self.seed = truth.seed if seed is None else seed
        self.true_lens: Lens = true_lens(truth)
        self.true_beacon: Beacon = displaced_beacon(truth, beacon)
        self.companions: tuple[tuple[Pose, Beacon], ...] = tuple(
            (_beside(k), companion) for k, companion in enumerate(companions)
        )
        rng = np.random.default_rng((self.seed, 4))
        self._rate = 2.0 * np.pi * rng.uniform(*_SWING_HZ, 6)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, 6)

    def true_camera_from_beacon(self, t_ns: int) -> Pose:
        """Where the beacon truly is at an instant."""
        swing = np.sin(self._rate * s_from_ns(t_ns) + self._phase)
        z_m = _DISTANCE_M[0] + _DISTANCE_M[1] * swing[2]
        lens = self.true_lens
        x_m = _PICTURE_SHARE * swing[0] * 0.5 * lens.width_px / lens.fx_px * z_m
        y_m = _PICTURE_SHARE * swing[1] * 0.5 * lens.height_px / lens.fy_px * z_m
        yaw, pitch, roll = rad_from_deg(_ANGLE_DEG) * swing[3:]
        return Pose(rotation_from_euler_zyx(yaw, pitch, roll), np.array([x_m, y_m, z_m]), "camera", "beacon")

    def true_camera_from(self, frame: str, _t_ns: int) -> Pose:
        """Where the frame camera, gantry or carriage stands."""
        if frame == "camera":
            return Pose.identity("camera", "camera")
        return self.truth.camera_from_gantry.pose("camera", frame)


def _beside(number: int) -> Pose:
    side = 1.0 if number % 2 == 0 else -1.0
    return Pose(np.eye(3), np.array([side * _BESIDE_M * (1 + number // 2), 0.0, 0.0]), "beacon", "beacon")
