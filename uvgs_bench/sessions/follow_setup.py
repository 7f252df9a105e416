"""What a follow session stands on: bench file, sensor, scene and follower, ready to be led."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from math import ceil
from pathlib import Path

import numpy as np

from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.devices.bench import Bench
from uvgs_bench.devices.follow_link import BodyState, FollowLink, open_follow_link
from uvgs_bench.devices.sim.camera import SimulatedCamera
from uvgs_bench.devices.sim.follow_scene import FollowScene
from uvgs_bench.devices.sim.free_flyer import FreeFlyer
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.errors import ConfigError, UnreadableDocument
from uvgs_bench.geometry import Pose
from uvgs_bench.navigation.margins import Loop, Margins, find_margins
from uvgs_bench.navigation.trajectory import Trajectory
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.follow_scenario import FollowFaults, FollowScenario
from uvgs_bench.store.beacons import read_beacon
from uvgs_bench.store.bench import read_bench
from uvgs_bench.store.calibrations import read_calibration
from uvgs_bench.store.documents import read_document
from uvgs_bench.units import s_from_ms


@dataclass(frozen=True, slots=True, eq=False)
class FollowSetUp:
    """Everything a follow session depends on, read and checked; nothing is open yet.

    Args:
        scenario: The scenario.
        faults: What goes wrong on purpose.
        bench: The bench.
        calibration: The camera.
        beacon: The leader's beacon.
        config: Settings of the sensor.
        seed: Seed of everything random.
    """

    scenario: FollowScenario
    faults: FollowFaults
    bench: Bench
    calibration: Calibration
    beacon: Beacon
    config: UvgsConfig
    seed: int

    @property
    def processing_s(self) -> float:
        """What the sensor takes for a capture when time is simulated, s: longer when others take the processor."""
        return s_from_ms(self.scenario.processing_ms) / (1.0 - self.faults.cpu)

    @property
    def latency_s(self) -> float:
        """From mid-exposure to the command, s."""
        return 0.5 * s_from_ms(self.scenario.exposure_ms) + self.processing_s + self.faults.latency_s

    @property
    def period_s(self) -> float:
        """Time between captures that are looked at, s: every one, or as many as the processor has time for."""
        period_s = 1.0 / self.scenario.rate_hz
        return period_s * max(1, ceil((self.processing_s + s_from_ms(self.scenario.exposure_ms)) / period_s - 1e-9))

    def loop(self) -> Loop:
        """The position loop near the station."""
        law = self.scenario.law
        return Loop(law.frequency_radps, law.damping, self.period_s, self.scenario.filter.window)

    def margins(self) -> Margins:
        """How far the loop is from losing its stability."""
        return find_margins(self.loop(), self.latency_s)

    def sensors(self) -> dict[str, Uvgs]:
        """One sensor for each hue the leader shows, by the hue's name, or the one of the beacon as its file says."""
        hues = tuple(dict.fromkeys(self.scenario.leader.hues()))
        beacons = [replace(self.beacon, name=hue, hue=hue) for hue in hues] or [self.beacon]
        found = {beacon.name: Uvgs(self.calibration, beacon, self.config) for beacon in beacons}
        for sensor in found.values():
            sensor.warm_up(colour=bool(hues))
        return found

    def truth(self) -> SimulatedTruth:
        """What is true of the simulated camera; in colour where hues are to be told apart."""
        truth = self.bench.simulated or SimulatedTruth()
        has_hues = bool(self.scenario.leader.hues())
        return replace(truth, camera=replace(truth.camera, is_colour=truth.camera.is_colour or has_hues))


@dataclass(frozen=True, slots=True, eq=False)
class FollowWorld:
    """What moves, and the eye on it.

    Args:
        link: The follower.
        leader: The leader's path.
        scene: What there is to see.
        camera: The follower's camera.
    """

    link: FollowLink
    leader: Trajectory
    scene: FollowScene
    camera: SimulatedCamera


def read_follow_setup(
    scenario: FollowScenario,
    bench: Path,
    faults: FollowFaults | None = None,
    seed: int = 0,
    sensor: Path | None = None,
) -> FollowSetUp:
    """Read and check everything a follow session depends on.

    Args:
        scenario: The scenario.
        bench: The bench file.
        faults: What goes wrong on purpose.
        seed: Seed of everything random.
        sensor: Settings of the sensor in place of the bench's.

    Returns:
        The set-up; no more captures a second than the sensor's ``rate_hz``.

    Raises:
        ConfigError: A file is missing or says something that cannot be meant.
    """
    described = read_bench(bench)
    camera_file = Path(described.camera_file)
    if not camera_file.exists():
        raise UnreadableDocument("no camera calibration: make one with uvgs calibrate", str(camera_file))
    file = described.sensor_file if sensor is None else sensor
    config = UvgsConfig() if file is None else read_document(Path(file), UvgsConfig)
    if 0.0 < config.rate_hz < scenario.rate_hz:
        scenario = replace(scenario, rate_hz=config.rate_hz)
    return FollowSetUp(
        scenario=scenario,
        faults=FollowFaults() if faults is None else faults,
        bench=described,
        calibration=read_calibration(camera_file),
        beacon=read_beacon(Path(described.beacon_file)),
        config=config,
        seed=seed,
    )


def open_world(set_up: FollowSetUp, plant: str) -> FollowWorld:
    """Set up leader, follower and camera.

    Args:
        set_up: What was read.
        plant: ``flyer`` or ``udp:HOST:PORT``.

    Returns:
        The world at its beginning; close its link at the end.

    Raises:
        ConfigError: The follower is unknown, or the truth does not fit the beacon.
        GantryError: The follower cannot be reached.
    """
    scenario = set_up.scenario
    leader = scenario.leader.trajectory()
    link = _open_link(set_up, plant, leader)
    try:
        scene = FollowScene(
            set_up.truth(),
            set_up.beacon,
            leader,
            lambda t_ns: link.state_at(t_ns).world_from_body,
            scenario.body_from_camera(),
            hues=scenario.leader.hues(),
            hidden_ns=set_up.faults.hidden_ns(),
            seed=set_up.seed,
        )
        camera = SimulatedCamera(scene, "sim:follow", None)
        camera.set_exposure_s(s_from_ms(scenario.exposure_ms))
    except BaseException:
        link.close()
        raise
    return FollowWorld(link, leader, scene, camera)


def _open_link(set_up: FollowSetUp, plant: str, leader: Trajectory) -> FollowLink:
    from uvgs_bench.navigation.rigid import rigid_state

    world_from_leader = rigid_state(leader.state_at(0.0), "world", "beacon").pose
    start: Pose = world_from_leader @ set_up.scenario.start()
    if plant != "flyer":
        return open_follow_link(plant, start)
    rng = np.random.default_rng((set_up.seed, 11))
    try:
        state = BodyState(0, start, np.zeros(3), np.zeros(3))
        return FreeFlyer(set_up.scenario.flyer, state, set_up.scenario.environment, rng)
    except ValueError as error:
        raise ConfigError(str(error), key="environment") from None


def calm_s(leader: Trajectory, t_s: float) -> float:
    """How long the leader has not accelerated at an instant, s; from the start when it never has."""
    accelerates = leader.acceleration.any(axis=1)
    ends_s = np.append(leader.begin_s[1:], leader.duration_s)
    inside = accelerates & (leader.begin_s <= t_s) & (t_s < ends_s)
    if inside.any():
        return 0.0
    past = ends_s[accelerates & (ends_s <= t_s)]
    return t_s - float(past.max()) if past.size else t_s


def setup_facts(set_up: FollowSetUp, plant: str, margins: Margins | None) -> dict[str, object]:
    """What the figures of a session depend on, as plain values for its manifest."""
    scenario = asdict(set_up.scenario)
    loop = (
        {}
        if margins is None
        else {
            "margins": _plain(asdict(margins)),
            "period_s": set_up.period_s,
        }
    )
    return {
        "plant": plant,
        "scenario": _plain(scenario),
        "faults": set_up.faults.text,
        "beacon": set_up.beacon.name,
        "camera": set_up.calibration.camera_name,
        "bench": set_up.bench.name,
        **loop,
    }


def _plain(value: object) -> object:
    """Tables, lists and numbers that TOML can carry: what is infinite or unknown is left out."""
    if isinstance(value, Mapping):
        kept = {str(key): _plain(item) for key, item in value.items()}
        return {key: item for key, item in kept.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
