"""Taking up a run that ended early: only on the same set-up, re-homed, and after a look at a station known before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt

import numpy as np

from uvgs_bench.errors import RunError
from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.se3 import so3_log
from uvgs_bench.sessions.events import EventSink, Remark, StageFinished, StageStarted, ignore_events
from uvgs_bench.sessions.planning import Plan
from uvgs_bench.sessions.sweep import (
    Rig,
    SweepResult,
    capture_station,
    check_live,
    closing_run,
    go_to,
    home,
    mean_pose,
    take_stations,
)
from uvgs_bench.store.run import Run, RunWriter, Seam
from uvgs_bench.store.run_writer import utc_now
from uvgs_bench.units import mm_from_m, mrad_from_rad

# What a homing switch and the axes of a bench gantry repeat to, on top of the sensor's own doubt.
_GANTRY_M, _GANTRY_RAD = 1e-4, 1e-3
_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class ReferenceCheck:
    """A station seen again.

    Args:
        station: Its number, -1 when there was none to see.
        shift_m: Distance between recorded and new mean position, m.
        allowed_m: What noise and repeatability explain, m.
        shift_rad: Angle between recorded and new mean attitude, rad.
        allowed_rad: What noise and repeatability explain, rad.
    """

    station: int = -1
    shift_m: float = 0.0
    allowed_m: float = 0.0
    shift_rad: float = 0.0
    allowed_rad: float = 0.0

    @property
    def is_passed(self) -> bool:
        """Whether nothing moved."""
        return self.shift_m <= self.allowed_m and self.shift_rad <= self.allowed_rad


def check_same_setup(
    run: Run, plan: Plan, hashes: Mapping[str, str], *, accepts_changes: bool = False
) -> tuple[str, ...]:
    """Refuse to resume a run on another set-up.

    Args:
        run: The run to resume.
        plan: The plan made now.
        hashes: SHA-256 of each set-up file and of the controller's settings now, by name.
        accepts_changes: Whether the user said that files and settings may differ; the planned stations may not.

    Returns:
        What changed and is accepted, by name, for the seam.

    Raises:
        RunError: The run is complete, or something changed; the message names all that did.
    """
    if run.is_complete:
        raise RunError("is complete, there is nothing to resume", str(run.path))
    recorded = run.manifest.hashes
    changed = [name for name in recorded if name in hashes and hashes[name] != recorded[name]]
    changed += [f"{name} (new)" for name in hashes if name not in recorded]
    changed += [f"{name} (missing)" for name in recorded if name not in hashes]
    if run.manifest.plan_hash != plan.plan_hash:
        changed.append("planned stations")
    elif accepts_changes:
        return tuple(changed)
    if changed:
        hint = "" if changed[-1] == "planned stations" else "; --accept-changes takes it up all the same and marks it"
        raise RunError(f"cannot be resumed, changed since it was begun: {', '.join(changed)}{hint}", str(run.path))
    return ()


def resume_sweep(
    run: Run,
    plan: Plan,
    rig: Rig,
    writer: RunWriter,
    *,
    sink: EventSink = ignore_events,
    accepted: tuple[str, ...] = (),
) -> SweepResult:
    """Home, look at a committed station again, mark the seam, and take what is missing.

    Args:
        run: The run as read, checked by ``check_same_setup``.
        plan: The same plan as then.
        rig: The open devices.
        writer: The reopened run; closed on return.
        sink: Receives progress.
        accepted: What changed since and is accepted, for the seam.

    Returns:
        What was taken now.

    Raises:
        RunError: Camera, beacon or gantry moved since, or no committed station has a pose to compare with; the run is
            closed again with that reason and loses nothing.
        UvgsError: As ``run_sweep``.
        KeyboardInterrupt: As ``run_sweep``.
    """
    committed = run.committed_stations()
    with closing_run(rig.gantry, writer, sink):
        check_live(rig)
        home(rig.gantry, sink)
        check = _look_again(run, plan, rig, committed, sink)
        if not check.is_passed:
            raise RunError(
                f"cannot be resumed: station {check.station} is seen {mm_from_m(check.shift_m):.3f} mm "
                f"(at most {mm_from_m(check.allowed_m):.3f}) and {mrad_from_rad(check.shift_rad):.2f} mrad "
                f"(at most {mrad_from_rad(check.allowed_rad):.2f}) from where it was: something moved",
                str(run.path),
            )
        writer.begin_again(
            Seam(
                resumed_utc=utc_now(),
                t_ns=rig.clock.now_ns() + writer.clock_offset_ns,
                clock_offset_ns=writer.clock_offset_ns,
                first_index=writer.sample_count,
                reference_station=check.station,
                shift_m=check.shift_m,
                shift_rad=check.shift_rad,
                accepted=accepted,
            )
        )
        sink(Remark("info", f"resumed: {len(committed)} of {len(plan.stations)} stations are on disk"))
        return take_stations(plan, rig, writer, sink, skip=committed)


def _look_again(run: Run, plan: Plan, rig: Rig, committed: frozenset[int], sink: EventSink) -> ReferenceCheck:
    if not committed:
        return ReferenceCheck()
    for station in plan.stations:
        if station.index not in committed:
            continue
        recorded = mean_pose([sample.outcome for sample in run.samples if sample.station == station.index])
        if recorded is None:
            continue
        sink(StageStarted("reference", 1))
        go_to(plan, station, rig)
        seen = mean_pose([outcome for _, outcome in capture_station(plan, rig, rig.clock.now_ns())])
        if seen is None:
            raise RunError(
                f"cannot be resumed: station {station.index} gave a pose before and gives none now", str(run.path)
            )
        (R0, t0_m, C0), (R1, t1_m, C1) = recorded, seen
        rotation = so3_log(np.ascontiguousarray(R1 @ R0.T))
        check = ReferenceCheck(
            station=station.index,
            shift_m=float(np.linalg.norm(t1_m - t0_m)),
            allowed_m=_GANTRY_M + _SIGMAS * _sigma_along(t1_m - t0_m, (C0 + C1)[3:, 3:]),
            shift_rad=float(np.linalg.norm(rotation)),
            allowed_rad=_GANTRY_RAD + _SIGMAS * _sigma_along(rotation, (C0 + C1)[:3, :3]),
        )
        sink(StageFinished("reference", f"station {station.index} moved by {mm_from_m(check.shift_m):.3f} mm"))
        return check
    raise RunError("cannot be resumed: no station on disk has a pose to compare with", str(run.path))


def _sigma_along(difference: FloatArray, covariance: FloatArray) -> float:
    """Standard deviation in the direction of a difference."""
    length = float(np.linalg.norm(difference))
    if length == 0.0:
        return 0.0
    unit = difference / length
    return sqrt(max(0.0, float(unit @ covariance @ unit)))
