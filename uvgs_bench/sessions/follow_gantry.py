"""A follow session in which the gantry itself is the follower, through the real driver.

On the simulated bench the other part moves as the scenario says; on a real one somebody moves it. Whatever ends the
session early stops the motion first.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from uvgs_bench.devices.cameras.registry import open_camera
from uvgs_bench.devices.cameras.source import CameraSource
from uvgs_bench.devices.clock import Clock, RealClock, SteppedClock
from uvgs_bench.devices.gantry.gantry import Gantry, MotionStream, StampedPosition
from uvgs_bench.devices.gantry.registry import open_gantry, spec_on_bench
from uvgs_bench.devices.sim.follow_scene import LedBench
from uvgs_bench.errors import CaptureError, ConfigError
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.navigation.follow_quality import BUSY, DROPPED
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.outcome import Miss, PoseEstimate
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.events import EventSink, Remark, StageAdvanced, StageFinished, StageStarted, ignore_events
from uvgs_bench.sessions.follow import OUTLIER, STAGE, FollowResult, free_session_folder, judged
from uvgs_bench.sessions.follow_setup import FollowSetUp, calm_s, setup_facts
from uvgs_bench.sessions.gantry_follower import (
    AHEAD_S,
    PIECE_S,
    AxisView,
    GantryFollower,
    law_for,
    position_at,
    tell_piece,
)
from uvgs_bench.sessions.interruption import check_interruption, interruptible
from uvgs_bench.sessions.provenance import program_versions
from uvgs_bench.store.follow_runs import FollowCycle, FollowManifest, FollowWriter
from uvgs_bench.store.run_writer import utc_now
from uvgs_bench.units import m_from_mm, mm_from_m, ns_from_s, s_from_ns

# Each axis is moved by this to see which way the beacon goes, m, at this speed, m/s; several pictures at each end.
_PROBE_M, _PROBE_MPS, _PROBE_CAPTURES = 0.01, 0.02, 5
_START_MPS = 0.05
_SETTLE_S = 0.3
_TRIES = 20
_KEPT_STAMPS = 400
_LONGEST_SLEEP_S = 0.02
_DARK_DN = 4


@dataclass(frozen=True, slots=True, eq=False)
class _Rig:
    """What is open."""

    gantry: Gantry
    camera: CameraSource
    sensor: Uvgs
    clock: Clock
    twin: LedBench | None


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """A capture, where the axes were, and what came of it; it may be used from ``ready_ns`` on."""

    index: int
    t_ns: int
    ready_ns: int
    estimate: PoseEstimate | None
    reason: str
    position: FloatArray


@dataclass(slots=True)
class _Progress:
    """What a session remembers while it runs."""

    stamps: list[StampedPosition] = field(default_factory=list)
    looks: list[_Look] = field(default_factory=list)
    busy_until_ns: int = 0
    said: str = ""


def follow_with_gantry(set_up: FollowSetUp, folder: Path, *, sink: EventSink = ignore_events) -> FollowResult:
    """Home, find out how the axes move the beacon, and keep its place before the camera for a scenario's time.

    Args:
        set_up: What was read; of the scenario count its leader, rate, law and filter.
        folder: Where the session's own folder is made.
        sink: Receives progress.

    Returns:
        The session with its figures.

    Raises:
        ConfigError: The bench has no linear axis, or the scenario shows several hues.
        RegistrationError: The axes do not move the beacon as they say.
        UvgsError: Gantry, camera or disk failed; the motion was stopped first.
        KeyboardInterrupt: The user stopped it; the motion was stopped first.
    """
    if set_up.scenario.leader.hues():
        raise ConfigError("a scenario with several hues cannot be followed with the gantry", key="--plant")
    with interruptible(), _open(set_up) as rig:
        _go_to_start(set_up, rig, sink)
        view = _probe(rig, sink)
        manifest = FollowManifest(
            set_up.scenario.name,
            utc_now(),
            "gantry",
            Pose.identity("beacon", "body"),
            set_up.seed,
            _facts(set_up, rig),
        )
        path = free_session_folder(folder, manifest)
        with FollowWriter(path, manifest) as writer:
            _Session(set_up, rig, view, writer, sink).lead()
    return judged(path)


def _facts(set_up: FollowSetUp, rig: _Rig) -> dict[str, object]:
    facts = setup_facts(set_up, "gantry", None)
    scenario = facts["scenario"]
    assert isinstance(scenario, dict)
    # The body of a free-flyer, its station and its start play no part here.
    for key in ("flyer", "environment", "offset_mm", "start_error_mm", "start_error_deg", "exposure_ms"):
        scenario.pop(key, None)
    return facts | {
        "mount": set_up.bench.mount,
        "is_simulated": rig.twin is not None,
        "is_realtime": rig.twin is None,
        "versions": program_versions(),
    }


@contextmanager
def _open(set_up: FollowSetUp) -> Iterator[_Rig]:
    """Open camera and gantry, simulated ones in stepped time."""
    bench = set_up.bench
    with ExitStack() as stack:
        clock: Clock = RealClock()
        gantry_spec, camera_spec, twin = bench.gantry_port, bench.camera_source, None
        if spec_on_bench(gantry_spec, "") is not None:
            clock = SteppedClock()
            axes = bench.nominal_axes or bench.envelope.axes
            twin = LedBench(set_up.truth(), set_up.beacon, axes, bench.mount, clock=clock, seed=set_up.seed)
            stack.callback(twin.close)
            gantry_spec, camera_spec = spec_on_bench(gantry_spec, twin.name) or twin.gantry_spec, twin.camera_spec
        sensor = Uvgs(set_up.calibration, set_up.beacon, set_up.config)
        sensor.warm_up()
        camera = stack.enter_context(open_camera(camera_spec, clock=clock))
        if not camera.is_live:
            raise ConfigError("following needs a live camera, this source is a recording", camera.spec)
        gantry = stack.enter_context(
            open_gantry(
                gantry_spec, bench.envelope, clock=clock, log=lambda *_: None, homing_timeout_s=bench.homing_timeout_s
            )
        )
        if not any(axis.kind == "linear" for axis in gantry.axes):
            raise ConfigError("following needs a linear axis", bench.path, "gantry.axes")
        yield _Rig(gantry, camera, sensor, clock, twin)


def _go_to_start(set_up: FollowSetUp, rig: _Rig, sink: EventSink) -> None:
    """Home, and go where the scenario's path lies in the middle of the envelope, as far as it is known."""
    check_interruption()
    sink(StageStarted("homing", 1))
    rig.gantry.home()
    sink(StageFinished("homing", "position known"))
    axes = rig.gantry.axes
    start = np.array([0.5 * (axis.lower + axis.upper) for axis in axes])
    if rig.twin is not None:
        leader = set_up.scenario.leader.trajectory()
        moved = np.array([leader.state_at(t).position[:3] for t in np.linspace(0.0, leader.duration_s, 200)])
        moved = (moved - moved[0]) @ rig.twin.true_camera_from("gantry", 0).R
        linear = [i for i, axis in enumerate(axes) if axis.kind == "linear"]
        along = moved @ np.linalg.pinv(np.array([axes[i].direction for i in linear]).T).T
        start[linear] -= 0.5 * (along.min(axis=0) + along.max(axis=0))
        reach = np.array([0.5 * (axes[i].upper - axes[i].lower) for i in linear])
        if (0.5 * np.ptp(along, axis=0) > reach).any():
            sink(Remark("warning", "the leader goes further than the axes can follow"))
        slowest = law_for(set_up.scenario.law, [axes[i] for i in linear]).speed_mps
        if moved.any() and m_from_mm(set_up.scenario.leader.speed_mm_s) > slowest:
            sink(Remark("warning", f"the leader is faster than the axes may follow, {mm_from_m(slowest):.0f} mm/s"))
        lower, upper = np.array([a.lower for a in axes]), np.array([a.upper for a in axes])
        room = np.minimum(2.0 * _PROBE_M, 0.25 * (upper - lower))
        start = np.clip(start, lower + room, upper - room)
    rig.gantry.move_to(start, _START_MPS)


def _probe(rig: _Rig, sink: EventSink) -> AxisView:
    """Move each linear axis a little and see how the beacon moves."""
    sink(StageStarted("probe", None))
    axes = rig.gantry.axes
    steps = []
    for number, axis in enumerate(axes):
        if axis.kind != "linear":
            continue
        before = _mean_place(rig)
        start = rig.gantry.state().position
        offset = np.zeros(len(axes))
        offset[number] = _PROBE_M if start[number] + _PROBE_M <= axis.upper else -_PROBE_M
        moved = rig.gantry.jog(offset, _PROBE_MPS).position - start
        after = _mean_place(rig)
        rig.gantry.move_to(start, _PROBE_MPS)
        steps.append((number, moved, after - before))
    view = AxisView.of(axes, steps, _mean_place(rig))
    sink(StageFinished("probe", f"{len(steps)} axes move the beacon as they say"))
    return view


def _mean_place(rig: _Rig) -> FloatArray:
    """Mean place of the beacon before the camera, the carriage at rest, shape (3,), m."""
    rig.clock.sleep(_SETTLE_S)
    places: list[FloatArray] = []
    miss: Miss | None = None
    for _ in range(_TRIES):
        check_interruption()
        outcome = rig.sensor.solve(_grab(rig))
        if isinstance(outcome, PoseEstimate):
            places.append(outcome.camera_from_beacon.t_m)
            if len(places) == _PROBE_CAPTURES:
                return np.asarray(np.mean(places, axis=0))
        else:
            miss = outcome
    why = "" if miss is None else f": {miss.detail}"
    raise CaptureError(f"the beacon is not seen at rest{why}", rig.camera.spec)


def _grab(rig: _Rig) -> Capture:
    capture = rig.camera.grab()
    if capture is None:
        raise CaptureError("the camera ended in the middle of a session", rig.camera.spec)
    return capture


class _Session:
    """One session under way."""

    def __init__(self, set_up: FollowSetUp, rig: _Rig, view: AxisView, writer: FollowWriter, sink: EventSink) -> None:
        self._set_up = set_up
        self._rig = rig
        self._view = view
        self._writer = writer
        self._sink = sink
        self._rng = np.random.default_rng((set_up.seed, 12))
        self._leader = set_up.scenario.leader.trajectory()
        self._begun_ns = 0
        self._carriage_start_m = np.zeros(3)
        self._prior: PoseEstimate | None = None

    def lead(self) -> None:
        """Follow for the scenario's time, come to rest, and close the record."""
        rig, scenario = self._rig, self._set_up.scenario
        now_ns = self._begun_ns = rig.clock.now_ns()
        if rig.twin is not None:
            self._carriage_start_m = rig.twin.true_gantry_from_carriage(now_ns).t_m
            rig.twin.lead(self._leader, now_ns)
        follower = GantryFollower(
            self._view, rig.gantry.envelope, rig.gantry.state().position, now_ns, scenario.law, scenario.filter
        )
        self._sink(StageStarted(STAGE, round(scenario.duration_s)))
        progress = _Progress()
        with rig.gantry.streaming() as stream:
            self._drive(stream, follower, progress)
        ending = "aborted" if follower.command.mode == "aborted" else "completed"
        reason = f"no pose for {scenario.law.abort_s:g} s" if ending == "aborted" else ""
        self._writer.close(ending, reason)
        self._sink(StageFinished(STAGE, f"{follower.command.mode} at the end"))

    def _drive(self, stream: MotionStream, follower: GantryFollower, progress: _Progress) -> None:
        rig, scenario = self._rig, self._set_up.scenario
        period_ns, piece_ns = ns_from_s(1.0 / scenario.rate_hz), ns_from_s(PIECE_S)
        next_ns = told_ns = self._begun_ns
        index = 0
        while True:
            check_interruption()
            progress.stamps = [*progress.stamps[-_KEPT_STAMPS:], stream.observe()[0]]
            follower.see(progress.stamps[-1])
            now_ns = rig.clock.now_ns()
            elapsed_s = s_from_ns(now_ns - self._begun_ns)
            # What is ready only after the end moves nothing, and is no part of the session.
            if elapsed_s >= scenario.duration_s or follower.command.mode == "aborted":
                break
            if now_ns >= next_ns:
                self._look(index, stream, progress)
                index += 1
                next_ns = max(next_ns + period_ns, rig.clock.now_ns() - period_ns)
                self._sink(StageAdvanced(STAGE, round(elapsed_s), follower.command.mode))
            self._answer(follower, progress)
            # A carriage that was not told in time has stopped: its path goes on from now.
            told_ns = max(told_ns, rig.clock.now_ns())
            while told_ns < rig.clock.now_ns() + ns_from_s(AHEAD_S):
                said = tell_piece(stream, follower, told_ns)
                if said and said != progress.said:
                    self._sink(Remark("warning", said))
                progress.said = said
                told_ns += piece_ns
            rig.clock.sleep(min(max(s_from_ns(next_ns - rig.clock.now_ns()), 0.0), _LONGEST_SLEEP_S))

    def _look(self, index: int, stream: MotionStream, progress: _Progress) -> None:
        """Take and solve a capture; where the axes were is known by the reports around it."""
        rig, set_up = self._rig, self._set_up
        begin_ns = rig.clock.now_ns()
        is_dropped = bool(self._rng.random() < set_up.faults.drop)
        is_busy = begin_ns < progress.busy_until_ns
        capture = self._covered(_grab(rig))
        progress.stamps.append(stream.observe()[0])
        estimate, reason = None, DROPPED if is_dropped else BUSY
        if not (is_dropped or is_busy):
            outcome = rig.sensor.solve(capture, self._prior)
            estimate = outcome if isinstance(outcome, PoseEstimate) else None
            reason = "" if isinstance(outcome, PoseEstimate) else f"{outcome.stage}/{outcome.reason}"
            self._prior = estimate
            progress.busy_until_ns = rig.clock.now_ns() + ns_from_s(set_up.processing_s)
        position = position_at(progress.stamps, capture.t_ns)
        if position is None:
            position, estimate = progress.stamps[-1].position, None
            reason = reason or "no report of the gantry near it"
        latency_ns = ns_from_s(set_up.faults.latency_s + set_up.processing_s * (rig.twin is not None))
        progress.looks.append(_Look(index, capture.t_ns, rig.clock.now_ns() + latency_ns, estimate, reason, position))

    def _covered(self, capture: Capture) -> Capture:
        """The capture, dark where the scenario hides the beacon: as if a hand lay on the lens."""
        at_ns = capture.t_ns - self._begun_ns
        if not any(begin <= at_ns < end for begin, end in self._set_up.faults.hidden_ns()):
            return capture
        return replace(capture, image=np.full_like(capture.image, _DARK_DN))

    def _answer(self, follower: GantryFollower, progress: _Progress) -> None:
        """Hand looks that are ready to the follower, and keep them."""
        now_ns = self._rig.clock.now_ns()
        while progress.looks and progress.looks[0].ready_ns <= now_ns:
            look = progress.looks.pop(0)
            accepted = look.estimate is not None and follower.take(look.estimate, look.position)
            self._record(follower, look, accepted=accepted)

    def _record(self, follower: GantryFollower, look: _Look, *, accepted: bool) -> None:
        view, axes = self._view, self._rig.gantry.axes
        sensed, sigma_m = None, np.full(3, np.nan)
        D = np.array([axes[i].direction for i in view.linear]).T
        if look.estimate is not None:
            off = D @ (look.position[list(view.linear)] - view.wanted(look.estimate, look.position))
            sensed = Pose(np.eye(3), off, "beacon", "body")
            sigma_m = np.sqrt(np.diag(D @ view.covariance(look.estimate) @ D.T))
        leader, body = self._truth(look, D)
        at_s = s_from_ns(look.t_ns - self._begun_ns)
        command = follower.command
        k = len(view.linear)
        self._writer.append(
            FollowCycle(
                index=look.index,
                t_ns=look.t_ns - self._begun_ns,
                answer_t_ns=look.ready_ns - self._begun_ns,
                leader=leader,
                body=body,
                sensed=sensed,
                sigma_m=sigma_m,
                is_accepted=accepted,
                reason=look.reason if look.estimate is None else "" if accepted else OUTLIER,
                beacon=self._set_up.beacon.name if look.estimate is not None else "",
                hue="",
                mode=command.mode,
                age_s=command.age_s,
                velocity_mps=D @ command.velocity_mps[:k],
                acceleration_mps2=D @ command.acceleration_mps2[:k],
                rate_radps=np.zeros(3),
                calm_s=calm_s(self._leader, at_s) if leader is not None else None,
                place=self._leader.state_at(at_s).place if leader is not None else 0,
            )
        )

    def _truth(self, look: _Look, D: FloatArray) -> tuple[Pose | None, Pose]:
        """Where the carriage was to be and was, gantry axes; true on the simulated bench, else as reported."""
        twin = self._rig.twin
        if twin is None:
            place = D @ look.position[list(self._view.linear)]
            return None, Pose(np.eye(3), place, "world", "body")
        wanted = self._carriage_start_m + twin.displacement_at(look.t_ns)
        here = twin.true_gantry_from_carriage(look.t_ns).t_m
        return Pose(np.eye(3), wanted, "world", "beacon"), Pose(np.eye(3), here, "world", "body")
