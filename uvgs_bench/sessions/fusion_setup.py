"""What a bag does not say about itself: mounting, beacon, noise, topics, as a TOML file; and the bag read by it."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from uvgs_bench.devices.sim.truth import TruePose
from uvgs_bench.errors import ConfigError, FormatError
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.interop.bags import open_bags
from uvgs_bench.interop.navigation_messages import (
    IMU,
    POSE_WITH_COVARIANCE,
    POSES,
    StampedPose,
    pose_from_message,
    reading_from_imu,
)
from uvgs_bench.navigation.fusion_data import FusionInput
from uvgs_bench.navigation.imu import STANDARD_GRAVITY_MPS2, ImuNoise, ImuSamples
from uvgs_bench.navigation.states import PoseMeasurement, SensedPose, tangent_from_place
from uvgs_bench.units import m_from_mm, ms_from_s, ns_from_s, rad_from_deg, s_from_ns

# A beacon of this size stands in where LEDs are only needed to measure a reprojection, m.
_USUAL_LEDS_M = read_only([[0.0, 0.08, 0.0], [-0.05, -0.07, 0.0], [0.05, -0.01, 0.0], [0.03, -0.05, -0.06]])
_USUAL_FOCAL_PX = 1000.0


@dataclass(frozen=True, slots=True)
class Topics:
    """Which topics are meant; empty ones are found by their types.

    Args:
        imu: ``sensor_msgs/Imu``.
        poses: Poses of the sensor, camera_from_beacon.
        native: Poses of another localiser, world_from_body.
    """

    imu: str = ""
    poses: str = ""
    native: str = ""


@dataclass(frozen=True, slots=True)
class FusionSetup:
    """The set-up of a fusion as people write it. Keys in file units.

    Args:
        imu: Noise of the inertial unit.
        gravity_mps2: Gravity in world axes, m/s^2; zeros in free fall.
        rest_s: How long the body stands still from the first reading on, s.
        body_from_camera: How the camera sits on the body, whose axes are those of the inertial unit.
        world_from_beacon: Where the beacon stands.
        sensor_offset_s: By how much the sensor's stamps are too late against those of the unit, s.
        native_offset_s: The same of the other localiser, s.
        sigma_floor_mm: Deviation added to the sensor's positions, mm.
        sigma_floor_deg: Deviation added to its rotations, deg.
        pose_sigma_mm: Deviation of poses that state none, mm.
        pose_sigma_deg: The same of rotations, deg.
        topics: Which topics are meant.
    """

    imu: ImuNoise = field(default_factory=ImuNoise)
    gravity_mps2: tuple[float, float, float] = (0.0, 0.0, -STANDARD_GRAVITY_MPS2)
    rest_s: float = 0.0
    body_from_camera: TruePose = TruePose()  # noqa: RUF009 - frozen
    world_from_beacon: TruePose = TruePose()  # noqa: RUF009 - frozen
    sensor_offset_s: float = 0.0
    native_offset_s: float = 0.0
    sigma_floor_mm: float = 0.5
    sigma_floor_deg: float = 0.05
    pose_sigma_mm: float = 10.0
    pose_sigma_deg: float = 1.0
    topics: Topics = Topics()

    def __post_init__(self) -> None:
        if self.rest_s < 0.0:
            raise ValueError(f"rest_s must not be negative, got {self.rest_s}")
        if min(self.sigma_floor_mm, self.sigma_floor_deg) < 0.0:
            raise ValueError("sigma_floor_mm and sigma_floor_deg must not be negative")
        if not min(self.pose_sigma_mm, self.pose_sigma_deg) > 0.0:
            raise ValueError("pose_sigma_mm and pose_sigma_deg must be positive")


def read_bag_input(paths: list[Path], setup: FusionSetup) -> FusionInput:
    """Read readings and poses from bags. Nothing is repaired silently: what was out of order or dropped is remarked.

    Args:
        paths: The bags, read as one.
        setup: What they do not say.

    Returns:
        The input; its truth is not known.

    Raises:
        FormatError: A bag cannot be read, or holds no pose.
        ConfigError: A topic is not there, has another type, or must be chosen.
    """
    name = ", ".join(str(path) for path in paths)
    with open_bags(paths) as bags:
        types, counts = bags.types, bags.counts
        imu_topic = _choose(types, counts, setup.topics.imu, (IMU,), "topics.imu", name, is_needed=False)
        pose_topic = _choose(types, counts, setup.topics.poses, POSES, "topics.poses", name, is_needed=True)
        native_topic = setup.topics.native and _choose(
            types, counts, setup.topics.native, POSES, "topics.native", name, is_needed=True
        )
        readings: list[tuple[int, FloatArray, FloatArray]] = []
        poses: list[tuple[StampedPose, int]] = []
        native: list[tuple[StampedPose, int]] = []
        for message in bags.messages({topic for topic in (imu_topic, pose_topic, native_topic) if topic}):
            topic, body = message.channel.topic, message.decode()
            try:
                if topic == imu_topic:
                    readings.append(reading_from_imu(body))
                if topic == pose_topic:
                    poses.append((pose_from_message(body, types[topic]), message.log_ns))
                if topic == native_topic:
                    native.append((pose_from_message(body, types[topic]), message.log_ns))
            except FormatError as error:
                raise FormatError(f"{topic}: {error}", name) from None
        remarks = list(bags.remarks)
    if not poses:
        raise FormatError(f"no pose on {pose_topic}", name)
    imu = _in_order(readings, imu_topic, remarks)
    sensed = _sensed(poses, pose_topic, setup, remarks)
    fixes = _native(native, native_topic, setup, remarks)
    said = f"readings of {imu_topic or 'no inertial unit'}, sensor poses of {pose_topic}"
    return FusionInput(
        name=name,
        words=said + (f", other poses of {native_topic}" if native_topic else ""),
        imu=imu,
        sensed=sensed,
        native=fixes,
        world_from_beacon=setup.world_from_beacon.pose("world", "beacon"),
        body_from_camera=setup.body_from_camera.pose("body", "camera"),
        leds_m=_USUAL_LEDS_M,
        focal_px=_USUAL_FOCAL_PX,
        noise=setup.imu,
        gravity_mps2=read_only(setup.gravity_mps2),
        rest_s=setup.rest_s,
        sigma_floor_m=m_from_mm(setup.sigma_floor_mm),
        sigma_floor_rad=rad_from_deg(setup.sigma_floor_deg),
        remarks=tuple(remarks),
    )


def _choose(
    types: dict[str, str],
    counts: dict[str, int],
    wanted: str,
    kinds: tuple[str, ...],
    key: str,
    bag: str,
    *,
    is_needed: bool,
) -> str:
    there = {topic for topic in types if types[topic] in kinds and counts.get(topic, 0)}
    if wanted:
        if wanted in there:
            return wanted
        known = ", ".join(sorted(there)) or "none"
        raise ConfigError(f"no topic '{wanted}' of {' or '.join(kinds)}, there is {known}", bag, key)
    if len(there) == 1:
        return next(iter(there))
    if not there and not is_needed:
        return ""
    if not there:
        held = ", ".join(sorted({kind for topic, kind in types.items() if counts.get(topic, 0)})) or "nothing"
        raise FormatError(f"holds no poses ({' or '.join(kinds)}), only {held}", bag)
    best = [topic for topic in there if types[topic] == POSE_WITH_COVARIANCE]
    if key == "topics.poses" and len(best) == 1:
        return best[0]
    raise ConfigError(f"several topics may be meant, choose one: {', '.join(sorted(there))}", bag, key)


def _in_order(readings: list[tuple[int, FloatArray, FloatArray]], topic: str, remarks: list[str]) -> ImuSamples:
    """Readings by their stamps; those that come twice are dropped."""
    stamps = [t_ns for t_ns, _, _ in readings]
    back = sum(b < a for a, b in pairwise(stamps))
    if back:
        remarks.append(f"{topic}: {back} readings lie before the one recorded before them; sorted by their stamps")
    by_stamp = {t_ns: (a, w) for t_ns, a, w in sorted(readings, key=lambda reading: reading[0])}
    if len(by_stamp) < len(readings):
        remarks.append(f"{topic}: {len(readings) - len(by_stamp)} readings repeat a stamp; the last of each was kept")
    values = list(by_stamp.values())
    empty = np.empty((0, 3))
    return ImuSamples(
        np.array(list(by_stamp), dtype=np.int64),
        np.array([a for a, _ in values]) if values else empty,
        np.array([w for _, w in values]) if values else empty,
    )


def _sensed(
    poses: list[tuple[StampedPose, int]], topic: str, setup: FusionSetup, remarks: list[str]
) -> tuple[SensedPose, ...]:
    ordered = _sorted(poses, topic, remarks)
    out = []
    for stamped, log_ns in ordered:
        pose = stamped.pose("camera", "beacon")
        covariance = tangent_from_place(pose, _doubt(stamped, setup))
        # The recorder's clock tells the delay only where it is that of the stamps.
        delay_ns = _delay(log_ns - stamped.t_ns)
        t_ns = stamped.t_ns - ns_from_s(setup.sensor_offset_s)
        out.append(SensedPose(t_ns, pose, read_only(covariance), delay_ns))
    _say_undoubted(ordered, topic, setup, remarks)
    return tuple(out)


def _native(
    poses: list[tuple[StampedPose, int]], topic: str, setup: FusionSetup, remarks: list[str]
) -> tuple[PoseMeasurement, ...]:
    ordered = _sorted(poses, topic, remarks) if poses else []
    _say_undoubted(ordered, topic, setup, remarks)
    return tuple(
        PoseMeasurement(
            stamped.t_ns - ns_from_s(setup.native_offset_s),
            stamped.pose("world", "body"),
            _doubt(stamped, setup),
            "native",
            _delay(log_ns - stamped.t_ns),
        )
        for stamped, log_ns in ordered
    )


def _sorted(poses: list[tuple[StampedPose, int]], topic: str, remarks: list[str]) -> list[tuple[StampedPose, int]]:
    back = sum(b[0].t_ns < a[0].t_ns for a, b in pairwise(poses))
    if back:
        remarks.append(f"{topic}: {back} poses lie before the one recorded before them; sorted by their stamps")
    by_stamp = {pose.t_ns: (pose, log_ns) for pose, log_ns in sorted(poses, key=lambda entry: entry[0].t_ns)}
    if len(by_stamp) < len(poses):
        remarks.append(f"{topic}: {len(poses) - len(by_stamp)} poses repeat a stamp; the last of each was kept")
    late = [log_ns - pose.t_ns for pose, log_ns in by_stamp.values()]
    middle_s = s_from_ns(int(np.median(late)))
    if abs(middle_s) > 1.0:
        remarks.append(f"{topic}: recorded {middle_s:.1f} s after its stamps; delays are unknown and taken as none")
    elif middle_s > 0.0:
        remarks.append(f"{topic}: recorded {ms_from_s(middle_s):.0f} ms after its stamps, which counts as delay")
    return list(by_stamp.values())


def _delay(late_ns: int) -> int:
    return late_ns if 0 <= late_ns <= ns_from_s(1.0) else 0


def _doubt(stamped: StampedPose, setup: FusionSetup) -> FloatArray:
    if stamped.covariance is not None:
        return stamped.covariance
    sigma = np.repeat((rad_from_deg(setup.pose_sigma_deg), m_from_mm(setup.pose_sigma_mm)), 3)
    return read_only(np.diag(sigma**2))


def _say_undoubted(poses: list[tuple[StampedPose, int]], topic: str, setup: FusionSetup, remarks: list[str]) -> None:
    count = sum(pose.covariance is None for pose, _ in poses)
    if count:
        remarks.append(
            f"{topic}: {count} poses state no covariance; taken as {setup.pose_sigma_mm:g} mm and "
            f"{setup.pose_sigma_deg:g} deg"
        )


def imu_remarks(source: FusionInput) -> tuple[str, ...]:
    """What is wrong with the readings beside the poses: missing, pausing, not reaching as far as the poses."""
    imu = source.imu
    if not len(imu):
        return ("no readings of an inertial unit",)
    out = []
    steps_s = np.diff(imu.t_ns) / 1e9
    if len(steps_s):
        usual_s = float(np.median(steps_s))
        gaps = np.flatnonzero(steps_s > max(0.1, 5.0 * usual_s))
        if len(gaps):
            k = int(gaps[np.argmax(steps_s[gaps])])
            at_s = s_from_ns(int(imu.t_ns[k] - imu.t_ns[0]))
            said = f"the inertial unit pauses {len(gaps)} times for more than {max(0.1, 5.0 * usual_s):.2f} s"
            out.append(f"{said}, the longest time for {steps_s[k]:.2f} s at {at_s:.1f} s")
    instants = [pose.t_ns for pose in source.sensed] + [m.t_ns for m in source.native]
    outside = sum(not imu.t_ns[0] <= t <= imu.t_ns[-1] for t in instants)
    if outside:
        out.append(f"{outside} of {len(instants)} poses lie outside the time of the readings")
    return tuple(out)
