"""What a recorded session is: samples, what was known before it began, how it ended, and where it was resumed."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from uvgs_bench.accuracy.observations import Mount, Role
from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate

if TYPE_CHECKING:
    from uvgs_bench.accuracy.judgement import Limit
    from uvgs_bench.beacon.geometry import Beacon
    from uvgs_bench.camera.calibration import Calibration

SETUP_OTHER_BEACON = "beacon_"
"""How the copies of a group's other beacons begin."""

Ending = Literal["completed", "interrupted", "failed", ""]


def _no_floats() -> FloatArray:
    return read_only(np.empty(0))


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One capture of a run.

    Args:
        index: Running number in the order of taking, from 0.
        station: Number of the visit in the plan, from 0; captures of one station share the carriage position.
        waypoint: Number of the place in the procedure, from 0; repeats and revisits share it.
        repeat: How often this waypoint was visited before.
        shot: Number of the capture within the station, from 0.
        role: Whether the station fits the registration or is judged by it.
        t_ns: Instant of mid-exposure, bench time, ns; never runs backwards within a run.
        target: Commanded machine axis positions at that instant, shape (A,), m or rad.
        position: Machine axis positions reported at rest, in motion those between two reports, shape (A,), m or rad.
        outcome: What the sensor answered.
        capture_file: File of the kept picture, relative to the run folder, or empty.
        attempt: Number of the try at this station, from 0; a resumed run retakes a half-done station.
        exposure_s: Exposure time, s, or None when unknown.
        velocity: Velocity of the axes by the same reports, shape (A,), m/s or rad/s; empty for a station at rest.
        active: Beacon that was to be looked at, by name, where there are several; empty where there is one.
        switched: Why another beacon became active in this capture; empty when none did.
        held_age_s: Age of the last valid pose that stands in for a miss, s; None when nothing is held.
        clipped_leds: How many LEDs had pixels at full scale; None when nobody looked.
    """

    index: int
    station: int
    waypoint: int
    repeat: int
    shot: int
    role: Role
    t_ns: int
    target: FloatArray
    position: FloatArray
    outcome: Outcome
    capture_file: str = ""
    attempt: int = 0
    exposure_s: float | None = None
    velocity: FloatArray = field(default_factory=_no_floats)
    active: str = ""
    switched: str = ""
    held_age_s: float | None = None
    clipped_leds: int | None = None

    def __post_init__(self) -> None:
        for name in ("target", "position", "velocity"):
            object.__setattr__(self, name, read_only(getattr(self, name), (-1,)))

    @property
    def is_moving(self) -> bool:
        """Whether any axis moved at that instant."""
        return bool(self.velocity.any())

    @property
    def is_solved(self) -> bool:
        """Whether the sensor gave a pose."""
        return isinstance(self.outcome, PoseEstimate)

    @property
    def reason(self) -> str:
        """``stage/reason`` of a miss, empty for a pose."""
        outcome = self.outcome
        return "" if isinstance(outcome, PoseEstimate) else f"{outcome.stage}/{outcome.reason}"


@dataclass(frozen=True, slots=True, eq=False)
class RunManifest:
    """Everything known before the first move.

    Args:
        id: Name of the run folder.
        created_utc: When it was begun, ISO 8601, UTC.
        procedure_name: Name of the procedure.
        mount: Which part rides the carriage.
        axes: The axes in the controller's order.
        limits: What the procedure demands to pass.
        seed: Seed of every random choice of the run.
        hashes: SHA-256 of each set-up file by its name, and of the controller's settings as ``controller_settings``.
        versions: Versions by name of program, library, or system.
        gantry_info: Firmware, version, options and settings of the controller as text.
        camera_spec: Spec of the camera source.
        gantry_spec: Spec of the gantry.
        simulated: Whether camera or gantry are simulated.
        plan_hash: SHA-256 of the planned stations.
        station_count: Number of planned stations.
        captures_per_station: Number of captures planned at each station.
        keep: Which pictures are kept: ``all``, ``worst`` or ``none``.
        started_t_ns: Bench time at ``created_utc``, ns.
        settle_s: Wait between arrival and the first exposure, s.
        gantry_sigma_m: Doubt of the carriage's position, standard deviation per axis, m.
        sources: Where each set-up file was read, by the name of its copy.
        mounted: How what rides the carriage sits on it, as built: carriage_from_beacon or camera_from_carriage; None
            when nobody said.
        approach: From where the carriage came to rest: ``none`` (straight from the last target), ``from_below``,
            ``from_above``; empty when nobody wrote it down.
    """

    id: str
    created_utc: str
    procedure_name: str
    mount: Mount
    axes: tuple[Axis, ...]
    limits: tuple[Limit, ...] = ()
    seed: int = 0
    hashes: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    gantry_info: dict[str, str] = field(default_factory=dict)
    camera_spec: str = ""
    gantry_spec: str = ""
    simulated: bool = False
    plan_hash: str = ""
    station_count: int = 0
    captures_per_station: int = 1
    keep: str = "all"
    started_t_ns: int = 0
    settle_s: float = 0.0
    gantry_sigma_m: float = 5e-5
    sources: dict[str, str] = field(default_factory=dict)
    mounted: Pose | None = None
    approach: str = ""


@dataclass(frozen=True, slots=True)
class Seam:
    """A place where an ended run was taken up again.

    Args:
        resumed_utc: When, ISO 8601, UTC.
        t_ns: Run time of the first moment after the seam, ns.
        clock_offset_ns: Run time minus the bench clock of the resumed part, ns.
        first_index: Index of the first sample after the seam.
        reference_station: Station that was visited again to prove that nothing moved, or -1 when there was none.
        shift_m: Distance between its recorded and its new mean position, m.
        shift_rad: Angle between its recorded and its new mean attitude, rad.
        accepted: Set-up files and settings that had changed, by name, and were accepted all the same.
    """

    resumed_utc: str
    t_ns: int
    clock_offset_ns: int
    first_index: int
    reference_station: int = -1
    shift_m: float = 0.0
    shift_rad: float = 0.0
    accepted: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One recorded session as read from disk.

    Args:
        path: The run folder.
        manifest: Everything known before the first move.
        samples: The samples that count, in the order of taking; superseded tries are left out.
        ended: How it ended; empty when it is still running or its program was killed.
        end_reason: Why, in one line; empty when completed.
        calibration: The camera calibration it was taken with, from the run's own copy.
        beacon: The beacon it was taken with, from the run's own copy.
        ended_utc: When it ended, ISO 8601, UTC, or empty.
        seams: Where it was resumed.
        remarks: What the reader noticed, for example a torn last line.
    """

    path: Path
    manifest: RunManifest
    samples: tuple[Sample, ...]
    ended: Ending
    end_reason: str
    calibration: Calibration
    beacon: Beacon
    ended_utc: str = ""
    seams: tuple[Seam, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def is_complete(self) -> bool:
        """Whether every planned station was taken and the run was closed."""
        return self.ended == "completed"

    @property
    def has_several_beacons(self) -> bool:
        """Whether it was taken of a group; the poses of all are in the frame of ``beacon``, their pixels are not."""
        return any(name.startswith(SETUP_OTHER_BEACON) for name in self.manifest.hashes)

    def committed_stations(self) -> frozenset[int]:
        """Stations of which every planned capture is on disk."""
        counts = Counter(sample.station for sample in self.samples)
        wanted = self.manifest.captures_per_station
        return frozenset(station for station, count in counts.items() if count >= wanted)

    def next_station(self) -> int:
        """First planned station that is not committed; the station count when none is left."""
        done = self.committed_stations()
        return next((i for i in range(self.manifest.station_count) if i not in done), self.manifest.station_count)
