"""A body that carries a camera and moves before a beacon that stands still: the scene of the fusion missions."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.sim.bench import displaced_beacon, true_lens
from uvgs_bench.devices.sim.camera import SimulatedCamera
from uvgs_bench.devices.sim.imu import TrueImu
from uvgs_bench.devices.sim.map_landmarks import LandmarkTruth
from uvgs_bench.devices.sim.truth import Occlusion, SimulatedTruth
from uvgs_bench.geometry import Pose, read_only
from uvgs_bench.navigation.imu import STANDARD_GRAVITY_MPS2
from uvgs_bench.navigation.rigid import RigidState, rigid_state
from uvgs_bench.navigation.trajectory import MotionLimits, PathPoint, Trajectory, plan_trajectory
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.units import ns_from_s, rad_from_deg, s_from_ns

# Camera axes (x right, y down, z forward) in axes of a body (x forward, y left, z up).
_LOOKING_AHEAD = read_only([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_REST_S = 4.0
_SIDE_M = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Mission:
    """A planned mission. World axes: x forward, y left, z up.

    Args:
        name: Its name.
        words: What happens in it, one sentence.
        path: The body's path: x, y, z, yaw, pitch, roll.
        world_from_beacon: Where the beacon stands.
        body_from_camera: How the camera sits on the body.
        hidden_s: From when to when something stands between camera and beacon, s.
        capture_rate_hz: Captures per second, Hz.
        native_rate_hz: Answers of the native localiser per second, Hz.
        sensor_delay_s: From capture to pose, s.
        native_delay_s: From picture to pose of the native localiser, s.
        imu: The inertial unit.
        landmarks: The native localiser's map.
        gravity_mps2: Gravity in world axes, m/s^2.
    """

    name: str
    words: str
    path: Trajectory
    world_from_beacon: Pose
    body_from_camera: Pose = field(
        default_factory=lambda: Pose(_LOOKING_AHEAD, np.array([0.118, -0.042, 0.06]), "body", "camera")
    )
    hidden_s: tuple[tuple[float, float], ...] = ()
    capture_rate_hz: float = 10.0
    native_rate_hz: float = 1.0
    sensor_delay_s: float = 0.03
    native_delay_s: float = 0.15
    imu: TrueImu = field(default_factory=TrueImu)
    landmarks: LandmarkTruth = field(default_factory=LandmarkTruth)
    gravity_mps2: tuple[float, float, float] = (0.0, 0.0, -STANDARD_GRAVITY_MPS2)

    @property
    def duration_s(self) -> float:
        """How long it takes, s."""
        return self.path.duration_s

    def state_at(self, t_s: float) -> RigidState:
        """The body at a time, s."""
        return rigid_state(self.path.state_at(t_s))

    def is_hidden(self, t_s: float) -> bool:
        """Whether something stands before the beacon at a time, s."""
        return any(start <= t_s < end for start, end in self.hidden_s)


def _beacon_at(x_m: float, y_m: float) -> Pose:
    """A beacon whose front looks back along x."""
    return Pose(_LOOKING_AHEAD, np.array([x_m, y_m, 0.06]), "world", "beacon")


def _path(places: list[tuple[float, float, float, float]], speed_mps: float) -> Trajectory:
    """Through x, y (m), yaw (deg), dwell (s), with rest at both ends."""
    points = [PathPoint(np.array([x, y, 0.0, rad_from_deg(yaw), 0.0, 0.0]), dwell) for x, y, yaw, dwell in places]
    return plan_trajectory(points, MotionLimits.rigid(speed_mps, 0.1, 0.2, 0.2))


def square_mission() -> Mission:
    """Two laps of a 30 cm square, 0.6 to 0.9 m before the beacon, walls in view."""
    half = 0.5 * _SIDE_M
    lap = [(_SIDE_M, -half, 5.0, 0.5), (_SIDE_M, half, -6.0, 0.5), (0.0, half, -4.0, 0.5), (0.0, -half, 0.0, 0.5)]
    path = _path([(0.0, -half, 0.0, _REST_S), *lap, *lap, (0.0, -half, 0.0, 1.0)], 0.05)
    return Mission("square", "two laps of a 30 cm square at 0.05 m/s", path, _beacon_at(1.05, 0.0))


def occlusion_mission() -> Mission:
    """To and fro at 0.1 m/s; the beacon is hidden for 2 s in full motion, and there is no other localiser."""
    half = 0.25
    leg = [(0.0, half, 4.0, 0.3), (0.0, -half, -4.0, 0.3)]
    path = _path([(0.0, -half, 0.0, _REST_S), *leg, *leg, *leg, (0.0, -half, 0.0, 1.0)], 0.1)
    # A leg takes 6.3 s with its wait; the third and fifth are hidden in their middle.
    hidden = ((18.5, 20.5), (31.0, 33.0))
    return replace(
        Mission("occlusion", "0.5 m to and fro at 0.1 m/s, beacon hidden for 2 s twice", path, _beacon_at(1.05, 0.0)),
        hidden_s=hidden,
        native_rate_hz=0.0,
    )


def gt2_mission() -> Mission:
    """Ground test 2: from where walls are seen to where the leader blocks and blinds, two laps there, and back."""
    half = 0.5 * _SIDE_M
    home = (0.0, -half)
    lap = [(_SIDE_M, -half, 8.0, 0.5), (_SIDE_M, half, -8.0, 0.5), (0.0, half, -5.0, 0.5), (*home, 3.0, 0.5)]
    far = (-0.9, 0.0, 0.0)
    path = _path([(*far, _REST_S), (*home, 3.0, 0.5), *lap, *lap, (*far, 4.0)], 0.05)
    words = "approach to a leader that blocks the wall and blinds the camera, two laps of a 30 cm square, and back"
    return replace(
        Mission("gt2", words, path, _beacon_at(0.88, 0.0)), landmarks=LandmarkTruth(glare_m2=0.8, shade_radius_m=0.28)
    )


MISSIONS = {"square": square_mission, "occlusion": occlusion_mission, "gt2": gt2_mission}
"""Name -> mission, as written after ``sim:``."""


class MissionScene:
    """What the mission's camera looks at.

    Args:
        mission: The mission.
        beacon: The beacon as its file says.
        truth: What is true of the camera.
        seed: Seed of all noise.
    """

    def __init__(self, mission: Mission, beacon: Beacon, truth: SimulatedTruth, seed: int) -> None:
        self.mission = mission
        self.truth = truth
        self.seed = seed
        self.true_lens: Lens = true_lens(truth)
        self.true_beacon: Beacon = displaced_beacon(truth, beacon)
        self.companions: tuple[tuple[Pose, Beacon], ...] = ()

    def true_camera_from_beacon(self, t_ns: int) -> Pose:
        """Where the beacon truly is at an instant."""
        mission = self.mission
        world_from_camera = mission.state_at(s_from_ns(t_ns)).pose @ mission.body_from_camera
        return world_from_camera.inverse() @ mission.world_from_beacon

    def true_camera_from(self, frame: str, _t_ns: int) -> Pose:
        """Only the camera itself stands before this camera; there is no gantry."""
        return Pose.identity("camera", frame)


class MissionCamera:
    """The camera of a mission; nothing is lit while something stands before the beacon.

    Args:
        scene: The scene.
    """

    def __init__(self, scene: MissionScene) -> None:
        names = scene.true_beacon.led_names
        dark = replace(scene.truth, occlusion=Occlusion(leds=names))
        blocked = MissionScene(scene.mission, scene.true_beacon, dark, scene.seed)
        self._scene = scene
        spec = f"sim:{scene.mission.name}"
        self._open, self._blocked = (SimulatedCamera(which, spec, None) for which in (scene, blocked))

    def capture_at(self, t_s: float, index: int) -> Capture:
        """The capture whose exposure begins at a time, s."""
        camera = self._blocked if self._scene.mission.is_hidden(t_s) else self._open
        return camera.capture_at(ns_from_s(t_s), index)
