"""The bench as a document: which camera, beacon and gantry stand together, and what is true on a simulated one."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from uvgs_bench.accuracy.observations import Mount
from uvgs_bench.devices.gantry.axes import Axis, AxisKind, Envelope
from uvgs_bench.devices.gantry.registry import is_simulated
from uvgs_bench.devices.sim.truth import SimulatedTruth, TruePose, Vector
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import hat
from uvgs_bench.units import m_from_mm, mps_from_mm_min, rad_from_deg, radps_from_deg_min

UNJUDGED = "nobody: the axes are taken as the bench file declares them"
_MOUNTED_FRAMES: dict[Mount, tuple[str, str]] = {
    "beacon_on_carriage": ("carriage", "beacon"),
    "camera_on_carriage": ("camera", "carriage"),
}
_STANDING_FRAMES: dict[Mount, tuple[str, str]] = {
    "beacon_on_carriage": ("camera", "gantry"),
    "camera_on_carriage": ("gantry", "beacon"),
}
_UNIT_OF_KIND: dict[AxisKind, str] = {"linear": "mm", "rotary": "deg"}


@dataclass(frozen=True, slots=True)
class AxisFile:
    """One ``[[gantry.axes]]`` table. A linear axis has the ``_mm`` keys, a rotary one the ``_deg`` keys.

    Args:
        name: The controller's letter.
        kind: ``linear`` or ``rotary``.
        direction: Direction of travel or axis of rotation in gantry axes.
        min_mm: Smallest machine position, mm.
        max_mm: Largest machine position, mm.
        max_feed_mm_min: Largest feed, mm/min.
        acceleration_mm_s2: Largest acceleration the controller may be set to, mm/s^2.
        backlash_mm: Known reversal, mm.
        min_deg: Smallest machine position, deg.
        max_deg: Largest machine position, deg.
        max_feed_deg_min: Largest feed, deg/min.
        acceleration_deg_s2: Largest acceleration, deg/s^2.
        backlash_deg: Known reversal, deg.
    """

    name: str
    direction: tuple[float, float, float]
    kind: AxisKind = "linear"
    min_mm: float | None = None
    max_mm: float | None = None
    max_feed_mm_min: float | None = None
    acceleration_mm_s2: float | None = None
    backlash_mm: float | None = None
    min_deg: float | None = None
    max_deg: float | None = None
    max_feed_deg_min: float | None = None
    acceleration_deg_s2: float | None = None
    backlash_deg: float | None = None

    def axis(self) -> Axis:
        """The axis in m or rad.

        Raises:
            ValueError: A key is missing, or belongs to the other kind, or its value is impossible.
        """
        unit = _UNIT_OF_KIND[self.kind]
        stranger = "deg" if unit == "mm" else "mm"
        for key in ("min", "max", "max_feed", "acceleration", "backlash"):
            if getattr(self, _unit_key(key, stranger)) is not None:
                raise ValueError(f"axis {self.name} is {self.kind}: {_unit_key(key, stranger)} has the wrong unit")

        def value(key: str) -> float:
            given: float | None = getattr(self, _unit_key(key, unit))
            if given is None:
                raise ValueError(f"axis {self.name} needs {_unit_key(key, unit)}")
            return given

        backlash: float = getattr(self, _unit_key("backlash", unit)) or 0.0
        length, speed = (m_from_mm, mps_from_mm_min) if unit == "mm" else (rad_from_deg, radps_from_deg_min)
        return Axis(
            name=self.name,
            kind=self.kind,
            direction=np.array(self.direction),
            lower=length(value("min")),
            upper=length(value("max")),
            max_speed=speed(value("max_feed")),
            acceleration=length(value("acceleration")),
            backlash=length(backlash),
        )


def _unit_key(key: str, unit: str) -> str:
    return f"{key}_{unit}" + {"max_feed": "_min", "acceleration": "_s2"}.get(key, "")


@dataclass(frozen=True, slots=True)
class GantryFile:
    """The ``[gantry]`` table.

    Args:
        axes: The axes in the controller's order.
        port: The spec of the gantry: ``grbl:/dev/ttyACM0``, or ``grbl:sim://`` for the simulated one.
        homing_timeout_s: How long homing may take, s.
        position_sigma_mm: What the carriage's position is doubted by, standard deviation per axis, mm.
        keep_out: Boxes no move may touch: for each, an interval by axis as ``X_mm = [lower, upper]`` or
            ``A_deg = [lower, upper]``; an axis not named is blocked over its whole travel.
        calibration: What ``uvgs gantry characterise`` found of scale and squareness, relative to the bench file.
        time_sigma_ms: Doubt of the captures' instants against the gantry's, standard deviation, ms; for the
            uncertainty budget of captures in motion.
        temperature_span_k: By how much the temperature of gantry and beacon may differ from when they were measured,
            from the lowest to the highest, K; for the uncertainty budget.
    """

    axes: tuple[AxisFile, ...]
    port: str = "grbl:sim://"
    homing_timeout_s: float = 120.0
    position_sigma_mm: float = 0.05
    keep_out: tuple[dict[str, tuple[float, float]], ...] = ()
    calibration: str | None = None
    time_sigma_ms: float | None = None
    temperature_span_k: float | None = None

    def __post_init__(self) -> None:
        if not self.position_sigma_mm > 0.0:
            raise ValueError(f"position_sigma_mm must be positive, got {self.position_sigma_mm}")
        for key in ("time_sigma_ms", "temperature_span_k"):
            value = getattr(self, key)
            if value is not None and not value >= 0.0:
                raise ValueError(f"{key} must not be negative, got {value}")

    def envelope(self) -> Envelope:
        """Axes and keep-out boxes in m and rad.

        Raises:
            ValueError: No axis, two of one name, or a keep-out box that names no axis or is upside down.
        """
        axes = tuple(axis.axis() for axis in self.axes)
        names = [axis.name for axis in axes]
        if not names or len(set(names)) != len(names):
            raise ValueError(f"a gantry needs axes with different names, got {', '.join(names) or 'none'}")
        return Envelope(axes, tuple(_box(axes, intervals) for intervals in self.keep_out))


def _box(axes: tuple[Axis, ...], intervals: dict[str, tuple[float, float]]) -> FloatArray:
    keys = {f"{axis.name}_{_UNIT_OF_KIND[axis.kind]}": i for i, axis in enumerate(axes)}
    box = np.array([[axis.lower for axis in axes], [axis.upper for axis in axes]])
    for key, (lower, upper) in intervals.items():
        if key not in keys:
            raise ValueError(f"keep_out: unknown key '{key}', expected one of: {', '.join(keys)}")
        if not lower < upper:
            raise ValueError(f"keep_out: {key} must be [lower, upper], got [{lower}, {upper}]")
        convert = m_from_mm if key.endswith("_mm") else rad_from_deg
        box[:, keys[key]] = convert(lower), convert(upper)
    return read_only(box)


@dataclass(frozen=True, slots=True)
class OtherBeaconFile:
    """One ``[[others]]`` table: a beacon that stands fixed beside the bench's own, as surveyed.

    Args:
        beacon: Its file.
        position_mm: Its origin in the frame of the bench's own beacon, mm.
        euler_zyx_deg: Its attitude there, intrinsic yaw, pitch, roll, deg.
        position_sigma_mm: Doubt of the position, standard deviation per axis, mm.
        attitude_sigma_deg: Doubt of the attitude, standard deviation per axis, deg.
    """

    beacon: str
    position_mm: Vector
    euler_zyx_deg: Vector = (0.0, 0.0, 0.0)
    position_sigma_mm: float = 0.5
    attitude_sigma_deg: float = 0.1

    def __post_init__(self) -> None:
        for name in ("position_sigma_mm", "attitude_sigma_deg"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, eq=False)
class OtherBeacon:
    """A beacon that stands fixed beside the bench's own.

    Args:
        file: Path of its file.
        beacon_from_other: Where it stands in the frame of the bench's own; both frames are called beacon.
        covariance: Doubt of that as a left tangent (omega, v), shape (6, 6), rad and m.
    """

    file: str
    beacon_from_other: Pose
    covariance: FloatArray

    @classmethod
    def of(cls, file: OtherBeaconFile, path: str) -> OtherBeacon:
        """From its table, with the path of its beacon file."""
        pose = TruePose(file.position_mm, file.euler_zyx_deg).pose("beacon", "beacon")
        position_m, attitude_rad = m_from_mm(file.position_sigma_mm), rad_from_deg(file.attitude_sigma_deg)
        # A turn about the beacon itself, not about the group's origin: dt = v + omega x t is independent of omega.
        J = np.eye(6)
        J[3:, :3] = hat(pose.t_m)
        spread = np.diag([attitude_rad**2] * 3 + [position_m**2] * 3)
        return cls(path, pose, read_only(J @ spread @ J.T))


@dataclass(frozen=True, slots=True)
class BenchFile:
    """The whole of ``bench.toml``; paths are relative to it.

    Args:
        name: Name of the bench.
        camera: Calibration file of the camera.
        beacon: Beacon file.
        gantry: The gantry.
        camera_source: Spec of the camera: ``uvc:0``, or ``sim:`` for the simulated one.
        mount: Which part rides the carriage.
        sensor: File with settings of the sensor; the defaults when absent.
        mounted: Roughly how what rides the carriage sits on it, as built: carriage_from_beacon, or camera_from_carriage
            with ``mount = "camera_on_carriage"``. Registrations take it where a sweep cannot tell.
        standing: Roughly how what stands is placed before the gantry, as built: camera_from_gantry, or
            gantry_from_beacon with ``mount = "camera_on_carriage"``; with ``mounted`` it tells beacons of a hue apart.
        others: Further beacons that stand fixed beside this one.
        simulated: What is true on the simulated bench.
    """

    name: str
    camera: str
    beacon: str
    gantry: GantryFile
    camera_source: str = "sim:"
    mount: Mount = "beacon_on_carriage"
    sensor: str | None = None
    mounted: TruePose | None = None
    standing: TruePose | None = None
    others: tuple[OtherBeaconFile, ...] = ()
    simulated: SimulatedTruth | None = None

    def mounted_pose(self) -> Pose | None:
        """The table ``[mounted]`` as a pose, or None."""
        return None if self.mounted is None else self.mounted.pose(*_MOUNTED_FRAMES[self.mount])

    def standing_pose(self) -> Pose | None:
        """The table ``[standing]`` as a pose, or None."""
        return None if self.standing is None else self.standing.pose(*_STANDING_FRAMES[self.mount])


@dataclass(frozen=True, slots=True, eq=False)
class Bench:
    """A bench as the program uses it.

    Args:
        name: Name of the bench.
        camera_file: Path of the camera's calibration file.
        beacon_file: Path of the beacon file.
        camera_source: Spec of the camera.
        gantry_port: Spec of the gantry.
        envelope: Axes and what they may reach, m and rad; with scale and direction as measured, where they were.
        mount: Which part rides the carriage.
        homing_timeout_s: How long homing may take, s.
        position_sigma_m: Doubt of the carriage's position, standard deviation per axis, m.
        sensor_file: Path of the sensor's settings, or None for the defaults.
        simulated: The truth of the simulated bench, or None when there is none.
        path: The file it was read from, or empty.
        nominal_axes: The axes as the bench file declares them.
        gantry_file: Path of the gantry's calibration, or None when the axes are taken as declared.
        judged_by: Who judged the gantry, in one line.
        mounted: How what rides the carriage sits on it, as built, or None when the file does not say.
        standing: How what stands is placed before the gantry, as built, or None when the file does not say.
        others: Further beacons that stand fixed beside this one.
    """

    name: str
    camera_file: str
    beacon_file: str
    camera_source: str
    gantry_port: str
    envelope: Envelope
    mount: Mount = "beacon_on_carriage"
    homing_timeout_s: float = 120.0
    position_sigma_m: float = 5e-5
    sensor_file: str | None = None
    simulated: SimulatedTruth | None = field(default=None)
    path: str = ""
    nominal_axes: tuple[Axis, ...] = ()
    gantry_file: str | None = None
    judged_by: str = UNJUDGED
    mounted: Pose | None = None
    standing: Pose | None = None
    others: tuple[OtherBeacon, ...] = ()

    @property
    def is_simulated(self) -> bool:
        """Whether camera and gantry are both the simulated ones of this file."""
        return is_simulated(self.gantry_port) and self.camera_source.startswith("sim:")
