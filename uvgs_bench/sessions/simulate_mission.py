"""Fly a simulated mission: rendered pixels through the real sensor, an inertial unit, a native localiser, the truth."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.devices.sim.imu import simulate_imu
from uvgs_bench.devices.sim.map_landmarks import MapLocaliser
from uvgs_bench.devices.sim.mission_scene import MISSIONS, Mission, MissionCamera, MissionScene
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import read_only
from uvgs_bench.navigation.fusion_data import FusionInput
from uvgs_bench.navigation.states import PoseMeasurement, SensedPose, place_from_tangent
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.events import EventSink, StageAdvanced, StageFinished, StageStarted
from uvgs_bench.store.beacons import read_beacon
from uvgs_bench.store.calibrations import read_calibration
from uvgs_bench.store.workspace import examples_folder
from uvgs_bench.units import ns_from_s, s_from_ns

_STAGE = "mission"
# The body stands at first; of that, what is safely before the first motion.
_REST_S = 3.0


def mission(name: str) -> Mission:
    """A mission by its name.

    Raises:
        ConfigError: There is none of this name.
    """
    if name not in MISSIONS:
        raise ConfigError(f"no mission '{name}', expected one of {', '.join(MISSIONS)}", f"sim:{name}")
    return MISSIONS[name]()


def simulate_mission(plan: Mission, seed: int, sink: EventSink = lambda event: None) -> FusionInput:
    """Fly a mission. Every pose of the sensor is solved from a rendered picture, through the example calibration.

    Args:
        plan: The mission.
        seed: Seed of all noise.
        sink: Where progress goes.

    Returns:
        What fusion gets, with the truth.

    Raises:
        UvgsError: The example calibration or beacon cannot be read.
    """
    beacon, calibration = _setup()
    scene = MissionScene(plan, beacon, SimulatedTruth(), seed)
    camera, sensor = MissionCamera(scene), Uvgs(calibration, beacon)
    times_s = np.arange(0.0, plan.duration_s, 1.0 / plan.capture_rate_hz)
    sink(StageStarted(_STAGE, len(times_s)))
    delay_ns = ns_from_s(plan.sensor_delay_s)
    sensed: list[SensedPose] = []
    misses: list[tuple[int, str]] = []
    prior: PoseEstimate | None = None
    for index, t_s in enumerate(times_s):
        outcome = sensor.solve(camera.capture_at(float(t_s), index), prior)
        if isinstance(outcome, PoseEstimate):
            sensed.append(SensedPose.of(outcome, delay_ns))
            prior = outcome
        else:
            misses.append((outcome.t_ns, outcome.reason))
            prior = None
        sink(StageAdvanced(_STAGE, index + 1, f"{len(sensed)} poses"))
    native, starved = _native(plan, scene, seed)
    sink(StageFinished(_STAGE, f"{len(times_s)} captures, {len(sensed)} poses, {len(native)} native poses"))
    unit = simulate_imu(
        plan.state_at, plan.duration_s, plan.imu, read_only(plan.gravity_mps2), np.random.default_rng((seed, 12))
    )
    return FusionInput(
        name=plan.name,
        words=plan.words,
        imu=unit.samples,
        sensed=tuple(sensed),
        native=native,
        world_from_beacon=plan.world_from_beacon,
        body_from_camera=plan.body_from_camera,
        leds_m=beacon.positions_m,
        focal_px=calibration.lens.fx_px,
        lens=calibration.lens,
        noise=plan.imu.noise,
        gravity_mps2=read_only(plan.gravity_mps2),
        rest_s=_REST_S,
        misses_ns=tuple(misses),
        starved_ns=starved,
        truth=lambda t_ns: plan.state_at(s_from_ns(t_ns)),
        is_simulated=True,
        remarks=("Simulated: path, pictures, inertial unit and native localiser; the poses were solved from pixels.",),
    )


def _native(
    plan: Mission, scene: MissionScene, seed: int
) -> tuple[tuple[PoseMeasurement, ...], tuple[tuple[int, int], ...]]:
    if plan.native_rate_hz <= 0.0:
        return (), ()
    beacon = plan.world_from_beacon
    localiser = MapLocaliser(scene.true_lens, plan.landmarks, beacon.t_m, beacon.R[:, 2], seed)
    fixes: list[PoseMeasurement] = []
    starved: list[tuple[int, int]] = []
    for t_s in np.arange(0.25, plan.duration_s, 1.0 / plan.native_rate_hz):
        t_ns = ns_from_s(float(t_s))
        fix = localiser.locate(plan.state_at(float(t_s)).pose @ plan.body_from_camera)
        if fix.world_from_camera is None or fix.covariance is None:
            starved.append((t_ns, fix.count))
            continue
        pose = fix.world_from_camera @ plan.body_from_camera.inverse()
        covariance = place_from_tangent(pose, fix.covariance)
        fixes.append(PoseMeasurement(t_ns, pose, covariance, "native", ns_from_s(plan.native_delay_s)))
    return tuple(fixes), tuple(starved)


@lru_cache(maxsize=1)
def _setup() -> tuple[Beacon, Calibration]:
    folder = examples_folder() / "calib"
    return read_beacon(folder / "beacons" / "tetra_small.toml"), read_calibration(folder / "cameras" / "simulated.yaml")
