"""Leading a sweep: home, carry the beacon to every station, settle, capture, solve, write, and always stop first."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from uvgs_bench.devices.cameras.source import CameraSource
from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.gantry.gantry import Gantry, GantryState
from uvgs_bench.errors import CaptureError, ConfigError, GantryLost, UvgsError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.se3 import hat, mean_rotation
from uvgs_bench.sensor.capture import Capture, ImageArray
from uvgs_bench.sensor.clipping import clipped_led_count
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate
from uvgs_bench.sessions.events import EventSink, Remark, StageAdvanced, StageFinished, StageStarted, ignore_events
from uvgs_bench.sessions.interruption import (
    check_interruption,
    impatient,
    interruptible,
    pausable,
    pause,
    undisturbed,
    wants_pause,
)
from uvgs_bench.sessions.planning import Plan, Station
from uvgs_bench.store.run import RunWriter, Sample
from uvgs_bench.units import ns_from_s, s_from_ns

# At rest a controller reports the target to its step and to three decimals of a millimetre (degree); a coarse belt
# drive has steps of 25 um, and a lost step shows.
_ARRIVED_M, _ARRIVED_RAD = 2e-5, 3.5e-4
# A live camera that still delivers old pictures after so many is not live.
_MOST_STALE_CAPTURES = 100
_MOST_REPORTS = 4


class Sensor(Protocol):
    """What turns a capture into a pose."""

    def solve(self, capture: Capture, prior: PoseEstimate | None = None) -> Outcome:
        """One capture in, one pose or a reason out."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Everything that is open during a sweep.

    Args:
        gantry: The gantry.
        camera: A live camera whose instants are on the same clock.
        sensor: The sensor.
        clock: Bench time.
    """

    gantry: Gantry
    camera: CameraSource
    sensor: Sensor
    clock: Clock


@dataclass(frozen=True, slots=True)
class SweepResult:
    """What a sweep brought home.

    Args:
        path: The run folder.
        station_count: Stations taken now.
        capture_count: Captures taken now.
        pose_count: Captures that gave a pose.
        misses: Number of misses by ``stage/reason``.
        duration_s: Bench time after homing, s.
    """

    path: Path
    station_count: int
    capture_count: int
    pose_count: int
    misses: dict[str, int] = field(default_factory=dict)
    duration_s: float = 0.0


def run_sweep(plan: Plan, rig: Rig, writer: RunWriter, *, sink: EventSink = ignore_events) -> SweepResult:
    """Home, take every station of a plan, and close the run, whatever happens.

    On Ctrl-C, SIGTERM or any failure the motion is stopped first, then the run is closed with the reason and whether
    the position is still known, then the exception goes on. Ctrl-Z pauses between two stations.

    Args:
        plan: The checked plan.
        rig: The open devices.
        writer: The open run; closed on return.
        sink: Receives progress.

    Returns:
        What was taken.

    Raises:
        ConfigError: The camera source is a recording.
        UvgsError: Gantry, camera or disk failed; the run is closed as ``failed``.
        KeyboardInterrupt: The user stopped it; the run is closed as ``interrupted``.
    """
    with closing_run(rig.gantry, writer, sink, is_resumable=plan.motion is None):
        check_live(rig)
        home(rig.gantry, sink)
        return take_stations(plan, rig, writer, sink)


def take_stations(
    plan: Plan, rig: Rig, writer: RunWriter, sink: EventSink, *, skip: frozenset[int] = frozenset()
) -> SweepResult:
    """Take the stations of a plan in order and close the run as completed; to be called within ``closing_run``.

    Args:
        plan: The checked plan.
        rig: The open devices, homed.
        writer: The open run.
        sink: Receives progress.
        skip: Stations that are on disk already.

    Returns:
        What was taken.

    Raises:
        UvgsError: Gantry, camera or disk failed.
    """
    begun_ns = rig.clock.now_ns()
    counts: Counter[str] = Counter()
    stations = [station for station in plan.stations if station.index not in skip]
    sink(StageStarted("sweep", len(plan.stations)))
    for done, station in enumerate(stations, start=1 + len(plan.stations) - len(stations)):
        if wants_pause():
            _pause(station, rig, writer, sink)
        samples = _take_station(plan, station, rig, writer)
        counts.update(sample.reason for sample in samples)
        solved = sum(sample.is_solved for sample in samples)
        sink(StageAdvanced("sweep", done, f"station {station.index}: {solved} of {len(samples)} poses"))
    if plan.motion is not None:
        from uvgs_bench.sessions.maneuver import drive_motion

        counts.update(sample.reason for sample in drive_motion(plan, rig, writer, sink))
    writer.close("completed")
    captures = sum(counts.values())
    poses = counts.pop("", 0)
    sink(StageFinished("sweep", f"{len(stations)} stations, {poses} poses of {captures} captures"))
    duration_s = s_from_ns(rig.clock.now_ns() - begun_ns)
    return SweepResult(writer.path, len(stations), captures, poses, dict(counts), duration_s)


def check_live(rig: Rig) -> None:
    """Refuse a recording. Raises ConfigError."""
    if not rig.camera.is_live:
        raise ConfigError("a sweep needs a live camera, this source is a recording", rig.camera.spec)


def home(gantry: Gantry, sink: EventSink) -> None:
    """Home the gantry with progress. Raises GantryError."""
    check_interruption()
    sink(StageStarted("homing", 1))
    gantry.home()
    sink(StageFinished("homing", "position known"))


def go_to(plan: Plan, station: Station, rig: Rig) -> GantryState:
    """Approach a station, arrive, settle, and make sure of the place.

    Args:
        plan: Gives feed and settling time.
        station: The station.
        rig: The open devices.

    Returns:
        The state at rest after settling.

    Raises:
        GantryLost: The position is not where it should be, or cannot be trusted.
        GantryError: The move failed.
    """
    procedure = plan.procedure
    for position in station.path:
        check_interruption()
        rig.gantry.move_to(position, _speed(rig.gantry, position, plan))
    rig.clock.sleep(procedure.settle_s)
    state = rig.gantry.state()
    _check_place(rig.gantry, state, station)
    return state


def capture_station(plan: Plan, rig: Rig, settled_ns: int) -> list[tuple[Capture, Outcome]]:
    """Take and solve the captures of a station.

    Args:
        plan: Gives their number.
        rig: The open devices.
        settled_ns: Bench time at which settling ended, ns; a capture whose exposure began earlier is discarded.

    Returns:
        Captures with what the sensor answered.

    Raises:
        CaptureError: The camera ended, failed, or keeps delivering old pictures.
    """
    out: list[tuple[Capture, Outcome]] = []
    stale = 0
    while len(out) < plan.procedure.captures_per_station:
        check_interruption()
        capture = rig.camera.grab()
        if capture is None:
            raise CaptureError("the camera ended in the middle of a sweep", rig.camera.spec)
        if capture.t_ns - ns_from_s(0.5 * (capture.exposure_s or 0.0)) < settled_ns:
            stale += 1
            if stale > _MOST_STALE_CAPTURES:
                raise CaptureError(
                    f"{stale} captures in a row were exposed before the carriage had settled; "
                    "its clock is not the bench clock, or it is not live",
                    rig.camera.spec,
                )
            continue
        out.append((capture, rig.sensor.solve(capture)))
    return out


def _take_station(plan: Plan, station: Station, rig: Rig, writer: RunWriter) -> list[Sample]:
    writer.check()
    before = go_to(plan, station, rig)
    taken = capture_station(plan, rig, rig.clock.now_ns())
    # Only captures of a carriage that stood still from before the first to after the last are written.
    state = _same_place(before, rig.gantry, station)
    samples: list[tuple[Sample, ImageArray | None]] = []
    for shot, (capture, outcome) in enumerate(taken):
        sample = Sample(
            index=writer.sample_count + shot,
            station=station.index,
            waypoint=station.waypoint,
            repeat=station.repeat,
            shot=shot,
            role=station.role,
            t_ns=capture.t_ns + writer.clock_offset_ns,
            target=station.target,
            position=state.position,
            outcome=outcome,
            attempt=writer.attempt_of(station.index),
            exposure_s=capture.exposure_s,
            clipped_leds=None if outcome.led_px is None else clipped_led_count(capture, outcome.led_px),
        )
        samples.append((sample, capture.image))
    return writer.append_station(samples)


def _speed(gantry: Gantry, position: FloatArray, plan: Plan) -> float:
    """Speed along the path, m/s, or rad/s for a move of rotary axes alone."""
    if all(axis.kind == "linear" for axis in gantry.axes):
        return plan.procedure.feed_mps
    here = gantry.state().position
    moving = [axis for axis, a, b in zip(gantry.axes, here, position, strict=True) if abs(b - a) > 1e-9]
    if not moving or any(axis.kind == "linear" for axis in moving):
        return plan.procedure.feed_mps
    return plan.procedure.feed_radps or min(axis.max_speed for axis in moving)


def _same_place(before: GantryState, gantry: Gantry, station: Station) -> GantryState:
    """The state that two reports agree on: a report has no checksum, so a digit that was damaged looks like a place."""
    for _ in range(_MOST_REPORTS):
        after = gantry.state()
        _check_place(gantry, after, station)
        if np.array_equal(before.position, after.position):
            return after
        before = after
    raise GantryLost(f"at station {station.index} the reported position changes at rest", gantry.port)


def _check_place(gantry: Gantry, state: GantryState, station: Station) -> None:
    if not state.is_trusted:
        raise GantryLost(
            f"at station {station.index} the position cannot be trusted: the controller says {state.activity}",
            gantry.port,
        )
    for axis, is_at, target in zip(gantry.axes, state.position, station.target, strict=True):
        tolerance = _ARRIVED_M if axis.kind == "linear" else _ARRIVED_RAD
        if not abs(float(is_at) - float(target)) <= tolerance:
            raise GantryLost(
                f"at station {station.index} axis {axis.name} stands at {axis.described(float(is_at))}, "
                f"expected {axis.described(float(target))}",
                gantry.port,
            )


@contextmanager
def closing_run(gantry: Gantry, writer: RunWriter, sink: EventSink, *, is_resumable: bool = True) -> Iterator[None]:
    """Whatever leaves this block: the motion is stopped first, then the run is closed with the reason.

    Args:
        gantry: The gantry.
        writer: The run; left alone when it was closed inside the block.
        sink: Receives how to resume.
        is_resumable: Whether the run can be taken up again.
    """
    with interruptible(), pausable():
        try:
            yield
        except BaseException as error:
            with undisturbed():
                is_wanted = isinstance(error, KeyboardInterrupt)
                reason = "stopped by the user" if is_wanted else " ".join(str(error).split()) or type(error).__name__
                is_sure, position = _stop(gantry)
                if not is_sure:
                    sink(Remark("warning", position))
                try:
                    writer.close("interrupted" if is_wanted else "failed", f"{reason}; {position}")
                except UvgsError as close_error:
                    sink(Remark("warning", str(close_error)))
                if is_resumable:
                    sink(Remark("warning", f"run closed; resume with: uvgs gantry-sweep --resume {writer.path}"))
            raise


def _stop(gantry: Gantry) -> tuple[bool, str]:
    """Stop the motion, hard when a second signal comes meanwhile; whether it stands, and what is known of where."""
    try:
        try:
            with impatient():
                state = gantry.stop()
        except KeyboardInterrupt:
            gantry.reset()
            return True, "stopped hard at the second interrupt, the position is lost"
    except UvgsError as error:
        return False, f"the gantry did not confirm that it stopped ({error}), the position is lost"
    return True, "the position is still known" if state.is_trusted else "the position is lost"


def _pause(station: Station, rig: Rig, writer: RunWriter, sink: EventSink) -> None:
    """Stand at rest before a station until told to go on; whatever the controller did meanwhile shows at the move."""
    text = f"paused before station {station.index}"
    sink(Remark("info", f"{text}: go on with fg, or kill -CONT {os.getpid()}"))
    writer.wire(rig.clock.now_ns(), "#", text)
    pause()
    writer.wire(rig.clock.now_ns(), "#", "going on")
    sink(Remark("info", "going on"))


def mean_pose(outcomes: Sequence[Outcome]) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Mean pose of the captures of one station.

    Args:
        outcomes: What the sensor answered.

    Returns:
        Mean rotation (3, 3), mean translation (3,), m, both camera_from_beacon, and the covariance of the mean of
        (omega, translation), shape (6, 6); None when no capture gave a pose.
    """
    poses = [outcome for outcome in outcomes if not isinstance(outcome, Miss)]
    if not poses:
        return None
    R = mean_rotation(np.array([pose.camera_from_beacon.R for pose in poses]))
    t_m = np.mean([pose.camera_from_beacon.t_m for pose in poses], axis=0)
    covariance = np.mean([pose_covariance(pose) for pose in poses], axis=0) / len(poses)
    return R, t_m, covariance


def pose_covariance(pose: PoseEstimate) -> FloatArray:
    """Covariance of (omega, translation): a left twist moves the translation by ``v - t x omega`` as well.

    Args:
        pose: The pose with the covariance of its left tangent.

    Returns:
        Covariance, shape (6, 6), rad and m, camera axes.
    """
    J = np.eye(6)
    J[3:, :3] = -hat(pose.camera_from_beacon.t_m)
    return np.asarray(J @ pose.covariance @ J.T)
