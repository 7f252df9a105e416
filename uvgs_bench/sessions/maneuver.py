"""Driving a motion and recording it: told, reported and seen poses on one clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from uvgs_bench.devices.gantry.gantry import MotionStream, StampedPosition
from uvgs_bench.errors import CaptureError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.navigation.trajectory import PathPoint, Trajectory, plan_trajectory
from uvgs_bench.sensor.capture import Capture, ImageArray
from uvgs_bench.sensor.clipping import clipped_led_count
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sessions.beacon_group import GroupSensor, Sight
from uvgs_bench.sessions.events import EventSink, Remark, StageAdvanced, StageFinished, StageStarted
from uvgs_bench.sessions.interruption import check_interruption
from uvgs_bench.sessions.pattern_trajectory import LOOK_AHEAD_S, Motion
from uvgs_bench.sessions.planning import Plan
from uvgs_bench.store.run import RunWriter, Sample
from uvgs_bench.units import mm_from_m, ms_from_s, ns_from_s, rad_from_deg, s_from_ns

if TYPE_CHECKING:
    from uvgs_bench.sessions.sweep import Rig

# How long a piece is that the controller is told, s: short enough for a cut corner, long enough for the line.
_PIECE_S = 0.025
_LOOK_S = 0.02
# A late carriage goes faster and an early one slower by at most this share; one that is later than this is waited for.
_CATCH_UP, _CATCH_UP_S, _WAIT_FOR_S = 0.1, 0.5, 0.15
# Pieces told later than this have let the carriage come to rest.
_DRY_S = 0.1
_SLOW = 1e-3
# Slower than this by two reports, m/s or rad/s, a carriage that is told to wait stands.
_STANDS = 1e-4
# Errors of lens and beacon hardly change over this, m and rad: laps come by the same places again.
_CELL_M, _CELL_RAD = 0.05, rad_from_deg(10.0)
_BATCH = 50
_MOST_HELD_BYTES = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class _Report:
    """Where the controller said the carriage was, and where it was told to be, at one instant.

    ``number`` counts everything that the gantry's own recording kept of this path, ``begun_ns`` is when the path began.
    """

    t_ns: int
    doubt_ns: int
    position: FloatArray
    told: FloatArray
    number: int
    begun_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class _Shot:
    """A capture with what was known of it at once; the reported position is known after the next report."""

    t_ns: int
    exposure_s: float | None
    image: ImageArray | None
    sight: Sight
    told: FloatArray
    told_velocity: FloatArray
    place: int
    clipped_leds: int | None


@dataclass(slots=True)
class _Record:
    """Everything of a motion that is not on disk yet, and figures of the whole; ``cells`` numbers where it came by."""

    reports: list[_Report] = field(default_factory=list)
    shots: list[_Shot] = field(default_factory=list)
    held_bytes: int = 0
    largest_lag_s: float = 0.0
    halts: int = 0
    samples: list[Sample] = field(default_factory=list)
    cells: dict[tuple[int, ...], int] = field(default_factory=dict)


def drive_motion(plan: Plan, rig: Rig, writer: RunWriter, sink: EventSink) -> list[Sample]:
    """Go to the begin of the plan's motion, drive it, and write a sample for every capture.

    Whatever ends it early stops the motion first; captures up to then are written all the same.

    Args:
        plan: A plan with a motion.
        rig: The open devices, homed.
        writer: The open run.
        sink: Receives progress.

    Returns:
        The samples as written.

    Raises:
        EnvelopeError: A correction would leave the envelope.
        CaptureError: The camera ended or failed.
        UvgsError: Gantry or disk failed.
    """
    motion = plan.motion
    assert motion is not None
    record = _Record()
    sink(StageStarted("motion", motion.capture_count))
    rig.gantry.move_to(motion.points[0].position, plan.procedure.feed_mps)
    rig.clock.sleep(plan.procedure.settle_s)
    try:
        if motion.correction_limit_m is None:
            _drive(motion, motion.trajectory(), 0, rig, record, writer, plan, sink)
        else:
            _drive_corrected(motion, motion.correction_limit_m, rig, record, writer, plan, sink)
    finally:
        _write(record, plan, writer)
    sink(
        StageFinished(
            "motion",
            f"{len(record.samples)} captures; late or early by {ms_from_s(record.largest_lag_s):.0f} ms at most; "
            f"its reports are sure to {ms_from_s(s_from_ns(max(r.doubt_ns for r in record.reports))):.1f} ms",
        )
    )
    if record.halts:
        sink(Remark("warning", f"the motion was waited for {record.halts} times: computer or controller was too slow"))
    return record.samples


def _drive_corrected(
    motion: Motion, limit_m: float, rig: Rig, record: _Record, writer: RunWriter, plan: Plan, sink: EventSink
) -> None:
    """Drive from wait to wait; at each the pose that is read shifts the rest of the path."""
    sensor = rig.sensor
    if not isinstance(sensor, GroupSensor):
        raise plan.procedure.error("needs a bench file that says roughly how everything stands", "trajectory.correct")
    shift = np.zeros(len(rig.gantry.axes))
    here = motion.points[0]
    for i, target in enumerate(motion.points[1:], start=1):
        wanted = PathPoint(target.position + shift, target.dwell_s)
        _drive(motion, plan_trajectory([here, wanted], motion.limits), i - 1, rig, record, writer, plan, sink)
        here = PathPoint(wanted.position)
        poses = _poses_at_rest(record)
        if poses:
            correction = np.clip(sensor.correction(poses, target.position), -limit_m, limit_m)
            # The carriage stands where the shift so far has brought it: what is missing now is added.
            shift = shift + correction
            place = motion.numbers[i]
            sink(Remark("info", f"at place {place} the rest of the path is corrected by {_described(rig, correction)}"))


def _poses_at_rest(record: _Record) -> list[PoseEstimate]:
    """The poses of the wait that has just ended."""
    poses: list[PoseEstimate] = []
    for shot in reversed(record.shots):
        if shot.told_velocity.any():
            break
        if isinstance(shot.sight.outcome, PoseEstimate):
            poses.append(shot.sight.outcome)
    return poses


def _described(rig: Rig, step: FloatArray) -> str:
    return ", ".join(
        f"{axis.name} {mm_from_m(float(value)):+.2f} mm"
        for axis, value in zip(rig.gantry.axes, step, strict=True)
        if axis.kind == "linear"
    )


def _drive(
    motion: Motion,
    path: Trajectory,
    first_place: int,
    rig: Rig,
    record: _Record,
    writer: RunWriter,
    plan: Plan,
    sink: EventSink,
) -> None:
    """Tell one trajectory piece by piece, look, and take captures."""
    period_ns = ns_from_s(1.0 / motion.captures_hz)
    count = int(np.ceil(path.duration_s / _PIECE_S))
    first_report = len(record.reports)
    with rig.gantry.recording() as kept, rig.gantry.streaming() as stream:
        begun_ns = next_ns = rig.clock.now_ns()
        told, is_resting = 0, True
        lag_s = _look(stream.observe()[0], len(kept) - 1, path, begun_ns, record)
        while True:
            check_interruption()
            now_s = s_from_ns(rig.clock.now_ns() - begun_ns)
            behind_s = max(now_s - told * _PIECE_S if told < count else 0.0, lag_s - _WAIT_FOR_S)
            if behind_s > _DRY_S:
                begun_ns += ns_from_s(behind_s)
                now_s -= behind_s
                record.halts += 1
            # A carriage at rest starts as soon as it is told: the first piece after a wait is told when it is due.
            while told < count and told * _PIECE_S <= now_s + (0.0 if is_resting else LOOK_AHEAD_S):
                told += 1
                is_resting = not _tell(stream, path, told, lag_s, motion)
            if rig.clock.now_ns() >= next_ns:
                shot = _shoot(rig, motion, path, first_place, begun_ns, writer.keep != "none")
                next_ns = max(next_ns + period_ns, rig.clock.now_ns() - period_ns)
                if shot is not None:
                    record.shots.append(shot)
                    record.held_bytes += 0 if shot.image is None else shot.image.nbytes
                    sink(StageAdvanced("motion", len(record.samples) + len(record.shots), shot.sight.active))
            lag_s = _look(stream.observe()[0], len(kept) - 1, path, begun_ns, record)
            if now_s >= path.duration_s:
                break
            if record.held_bytes > _MOST_HELD_BYTES:
                _write(record, plan, writer)
            due_s = s_from_ns(next_ns - rig.clock.now_ns())
            rig.clock.sleep(min(_LOOK_S, max(due_s, 0.0)))
    record.reports[first_report:] = [_surest(report, kept, path) for report in record.reports[first_report:]]
    at_rest = rig.gantry.state()
    record.reports.append(_Report(at_rest.t_ns, 0, at_rest.position, path.last, -1, begun_ns))


def _surest(report: _Report, kept: Sequence[StampedPosition], path: Trajectory) -> _Report:
    """The report with the instant that a controller with a clock of its own has said, where that is surer."""
    stamp = kept[report.number]
    if stamp.doubt_ns >= report.doubt_ns:
        return report
    told = path.state_at(s_from_ns(stamp.t_ns - report.begun_ns)).position
    return replace(report, t_ns=stamp.t_ns, doubt_ns=stamp.doubt_ns, told=told)


def _tell(stream: MotionStream, path: Trajectory, number: int, lag_s: float, motion: Motion) -> bool:
    """Tell the piece that ends at an instant of the path, faster while the carriage is late and slower while early.

    Returns:
        Whether it moves anything.
    """
    target = path.state_at(number * _PIECE_S).position
    step = target - stream.end
    linear = float(np.linalg.norm(step[~motion.limits.is_rotary]))
    length = linear if linear > 1e-9 else float(np.linalg.norm(step))
    if length <= 1e-9:
        return False
    haste = 1.0 + min(max(lag_s / _CATCH_UP_S, -_CATCH_UP), _CATCH_UP)
    stream.order(target, haste * length / _PIECE_S)
    return True


def _look(stamp: StampedPosition, number: int, path: Trajectory, begun_ns: int, record: _Record) -> float:
    """Keep a report; by how much the carriage is late, s, where it moves fast enough to tell."""
    state = path.state_at(s_from_ns(stamp.t_ns - begun_ns))
    record.reports.append(_Report(stamp.t_ns, stamp.doubt_ns, stamp.position, state.position, number, begun_ns))
    square = float(state.velocity @ state.velocity)
    if square < _SLOW * _SLOW:
        return 0.0
    lag_s = float((state.position - stamp.position) @ state.velocity) / square
    if square > 100.0 * _SLOW * _SLOW:
        record.largest_lag_s = max(record.largest_lag_s, abs(lag_s))
    return lag_s


def _shoot(
    rig: Rig, motion: Motion, path: Trajectory, first_place: int, begun_ns: int, keeps_image: bool
) -> _Shot | None:
    """Take and solve one capture; None for one from before the motion."""
    capture: Capture | None = rig.camera.grab()
    if capture is None:
        raise CaptureError("the camera ended in the middle of a motion", rig.camera.spec)
    if capture.t_ns < begun_ns:
        return None
    state = path.state_at(s_from_ns(capture.t_ns - begun_ns))
    place = motion.numbers[min(first_place + state.place, len(motion.numbers) - 1)]
    if isinstance(rig.sensor, GroupSensor):
        wanted = motion.beacons[place] if motion.beacons else None
        sight = rig.sensor.look(capture, state.position, wanted)
    else:
        sight = Sight(rig.sensor.solve(capture))
    image = capture.image if keeps_image else None
    led_px = sight.outcome.led_px
    clipped = None if led_px is None else clipped_led_count(capture, led_px)
    return _Shot(capture.t_ns, capture.exposure_s, image, sight, state.position, state.velocity, place, clipped)


def _write(record: _Record, plan: Plan, writer: RunWriter) -> None:
    """Put what was taken on disk, as far as reports say where the carriage was."""
    if not record.shots or len(record.reports) < 2:
        return
    taken = _samples(record, plan, writer)
    for i in range(0, len(taken), _BATCH):
        record.samples += writer.append_station(taken[i : i + _BATCH])
    record.shots.clear()
    record.held_bytes = 0


def _samples(record: _Record, plan: Plan, writer: RunWriter) -> list[tuple[Sample, ImageArray | None]]:
    reports = sorted(record.reports, key=lambda report: report.t_ns)
    times = np.array([report.t_ns for report in reports], dtype=np.int64)
    positions = np.array([report.position for report in reports])
    offsets = positions - np.array([report.told for report in reports])
    out: list[tuple[Sample, ImageArray | None]] = []
    before = record.samples[-1] if record.samples else None
    for shot in record.shots:
        k = int(np.clip(np.searchsorted(times, shot.t_ns, side="right"), 1, len(times) - 1))
        span_s = max(s_from_ns(int(times[k] - times[k - 1])), 1e-6)
        if not times[k - 1] <= shot.t_ns <= times[k]:
            continue
        share = s_from_ns(int(shot.t_ns - times[k - 1])) / span_s
        # Between two reports the way of the told path is taken, displaced as much as the reports are.
        position = shot.told + offsets[k - 1] + share * (offsets[k] - offsets[k - 1])
        velocity = shot.told_velocity + (offsets[k] - offsets[k - 1]) / span_s
        if not shot.told_velocity.any() and float(np.abs(velocity).max()) < _STANDS:
            velocity = np.zeros_like(velocity)
            position = positions[k]
        before = _sample(shot, position, velocity, before, plan, record, writer.sample_count + len(out))
        before = replace(before, t_ns=before.t_ns + writer.clock_offset_ns)
        out.append((before, shot.image))
    return out


def _sample(
    shot: _Shot,
    position: FloatArray,
    velocity: FloatArray,
    before: Sample | None,
    plan: Plan,
    record: _Record,
    index: int,
) -> Sample:
    """Captures of one wait share station and place; those in motion share the place of their cell, and its errors."""
    is_moving = bool(velocity.any())
    waits = plan.waypoint_count + shot.place
    is_same_wait = before is not None and not is_moving and not before.is_moving and before.waypoint == waits
    wait = before if is_same_wait else None
    assert plan.motion is not None
    size = np.where(plan.motion.limits.is_rotary, _CELL_RAD, _CELL_M)
    cell = tuple(int(i) for i in np.round(position / size))
    places = plan.waypoint_count + 1 + max(plan.motion.numbers)
    return Sample(
        index=index,
        station=len(plan.stations) + index if wait is None else wait.station,
        waypoint=places + record.cells.setdefault(cell, len(record.cells)) if is_moving else waits,
        repeat=0,
        shot=0 if wait is None else wait.shot + 1,
        role="judge",
        t_ns=shot.t_ns,
        target=shot.told,
        position=position,
        outcome=shot.sight.outcome,
        exposure_s=shot.exposure_s,
        velocity=velocity,
        active=shot.sight.active,
        switched=shot.sight.switched,
        held_age_s=shot.sight.held_age_s,
        clipped_leds=shot.clipped_leds,
    )
