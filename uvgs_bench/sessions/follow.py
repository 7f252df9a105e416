"""Leading a follow session: pictures to poses to commands to motion, on one clock.

Two kinds of events in order of time: a capture is exposed; later, when sensor and injected latency are done with it, a
command is made and sent. Time is simulated, and the session the same every time, unless it is asked to keep pace with
the wall clock.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uvgs_bench.devices.clock import RealClock
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import Pose
from uvgs_bench.navigation.follow_quality import BUSY, DROPPED, FollowQuality
from uvgs_bench.navigation.follower import FollowCommand, follow_step, rest_command
from uvgs_bench.navigation.margins import Margins
from uvgs_bench.navigation.pose_filter import PoseMemory, RelativePose, relative_pose, smoothed, take_pose
from uvgs_bench.sensor.handover import HandoverPolicy, HandoverState, hand_over, solve_all
from uvgs_bench.sensor.outcome import Outcome, PoseEstimate
from uvgs_bench.sessions.events import EventSink, Remark, StageAdvanced, StageFinished, StageStarted, ignore_events
from uvgs_bench.sessions.follow_margin import simulated_largest_latency
from uvgs_bench.sessions.follow_setup import FollowSetUp, FollowWorld, calm_s, open_world, setup_facts
from uvgs_bench.sessions.interruption import check_interruption, interruptible
from uvgs_bench.sessions.provenance import program_versions
from uvgs_bench.store.follow_judging import judge_follow, verdict_of
from uvgs_bench.store.follow_runs import FollowCycle, FollowManifest, FollowRun, FollowWriter, read_follow_run
from uvgs_bench.store.run_writer import utc_now
from uvgs_bench.units import ns_from_s, s_from_ms, s_from_ns

STAGE = "follow"
OUTLIER = "outlier"
# How long a session goes on after the law gave up, s: long enough to see it come to rest.
_AFTER_ABORT_S = 2.0
_PROGRESS_EVERY_S = 1.0
_EXPOSE, _ANSWER = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class FollowResult:
    """What a session brought home.

    Args:
        run: The session as read back from disk.
        quality: Its figures.
        verdict: ``pass``, ``fail`` or ``inconclusive``.
        headline: Why, in one line.
    """

    run: FollowRun
    quality: FollowQuality
    verdict: str
    headline: str


@dataclass(frozen=True, slots=True, eq=False)
class _Answer:
    """What became of a capture: a relative pose or a reason, and what was known of it."""

    index: int
    t_ns: int
    pose: RelativePose | None
    reason: str
    beacon: str
    hue: str
    leader: Pose
    body: Pose
    calm_s: float
    place: int


def follow(
    set_up: FollowSetUp,
    folder: Path,
    *,
    plant: str = "flyer",
    realtime: bool = False,
    tried_s: float | None = None,
    sink: EventSink = ignore_events,
) -> FollowResult:
    """Run a scenario and keep it.

    Args:
        set_up: What was read.
        folder: Where the session's own folder is made.
        plant: ``flyer`` or ``udp:HOST:PORT``.
        realtime: Keep pace with the wall clock and take the sensor's true time; a follower outside always does.
        tried_s: The latency borne by trying, where it is known already, s.
        sink: Receives progress.

    Returns:
        The session with its figures.

    Raises:
        ConfigError: The follower is unknown, or the loop is unstable by itself.
        UvgsError: The follower or the disk failed; the session is closed as ``failed``.
        KeyboardInterrupt: The user stopped it; the session is closed as ``interrupted``.
    """
    margins = set_up.margins()
    if margins.largest_latency_s <= 0.0:
        raise ConfigError(
            f"with {set_up.scenario.filter.window} poses at {1.0 / set_up.period_s:.3g} Hz the loop is unstable even "
            "without latency: lower frequency_radps or window, or raise rate_hz",
            key="law",
        )
    if not margins.is_stable:
        bears = f"the loop bears {margins.largest_latency_s:.3f} s"
        sink(Remark("warning", f"unstable: latency {margins.latency_s:.3f} s, {bears}"))
    with interruptible():
        shown = simulated_margin(set_up, margins, sink) if tried_s is None else tried_s
        world = open_world(set_up, plant)
        try:
            facts = setup_facts(set_up, plant, margins) | {
                "versions": program_versions(),
                "is_realtime": realtime or world.link.has_own_time,
                "simulated_largest_latency_s": shown,
            }
            manifest = FollowManifest(
                set_up.scenario.name, utc_now(), plant, set_up.scenario.station(), set_up.seed, facts
            )
            path = free_session_folder(folder, manifest)
            with FollowWriter(path, manifest) as writer:
                _Session(set_up, world, writer, realtime or world.link.has_own_time, sink).lead()
        finally:
            world.link.close()
    return judged(path)


def simulated_margin(set_up: FollowSetUp, margins: Margins, sink: EventSink = ignore_events) -> float:
    """The largest latency by trying, s, beside the one by computing; ``follow_margin`` says how."""
    sink(StageStarted("latency", None))
    scenario = set_up.scenario
    found_s = simulated_largest_latency(
        scenario.law, scenario.filter, scenario.flyer, set_up.period_s, 1.5 * margins.largest_latency_s,
        scenario.environment,
    )  # fmt: skip
    said = (
        f"bears {margins.largest_latency_s:.3f} s by the loop, {found_s:.3f} s by trying; has {margins.latency_s:.3f} s"
    )
    sink(StageFinished("latency", said))
    return found_s


def judged(path: Path) -> FollowResult:
    """A session on disk with its figures. Raises RunError."""
    run = read_follow_run(path)
    quality = judge_follow(run)
    verdict, headline = verdict_of(run, quality)
    return FollowResult(run, quality, verdict, headline)


def free_session_folder(folder: Path, manifest: FollowManifest) -> Path:
    """A folder of its own for a session, named by instant and scenario."""
    stamp = manifest.created_utc.split(".")[0].replace("-", "").replace(":", "")
    name = f"{stamp}Z_follow_{manifest.name}"
    path, number = folder / name, 1
    while path.exists():
        number += 1
        path = folder / f"{name}-{number}"
    return path


class _Session:
    """One session under way."""

    def __init__(
        self, set_up: FollowSetUp, world: FollowWorld, writer: FollowWriter, keeps_pace: bool, sink: EventSink
    ) -> None:
        self._set_up = set_up
        self._scenario = set_up.scenario
        self._world = world
        self._writer = writer
        self._sink = sink
        self._sensors = set_up.sensors()
        self._clock = RealClock() if keeps_pace else None
        self._rng = np.random.default_rng((set_up.seed, 12))
        self._period_ns = ns_from_s(1.0 / self._scenario.rate_hz)
        self._exposure_ns = ns_from_s(s_from_ms(self._scenario.exposure_ms))
        self._end_ns = ns_from_s(self._scenario.duration_s)
        self._policy = HandoverPolicy(hold_s=0.0)
        self._handover = HandoverState()
        self._priors: dict[str, PoseEstimate] = {}
        self._station = self._scenario.station()
        self._memory = PoseMemory()
        self._command: FollowCommand = rest_command(0, self._scenario.law)
        self._busy_until_ns = 0
        self._late_count = 0

    def lead(self) -> None:
        """Run to the end and close the session's record."""
        self._sink(StageStarted(STAGE, round(s_from_ns(self._end_ns))))
        begun_ns = 0 if self._clock is None else self._clock.now_ns()
        events: list[tuple[int, int, int, _Answer | None]] = [(0, _EXPOSE, 0, None)]
        said_s = 0.0
        while events:
            t_ns, kind, index, answer = heapq.heappop(events)
            check_interruption()
            if t_ns > self._end_ns:
                break
            if self._clock is not None:
                early_s = s_from_ns(t_ns - (self._clock.now_ns() - begun_ns))
                self._clock.sleep(early_s)
                self._late_count += early_s < -1.0 / self._scenario.rate_hz
            if kind == _EXPOSE:
                ready_ns, made = self._expose(t_ns, index)
                heapq.heappush(events, (ready_ns, _ANSWER, index, made))
                heapq.heappush(events, (t_ns + self._period_ns, _EXPOSE, index + 1, None))
            elif answer is not None:
                self._obey(t_ns, answer)
                if self._command.mode == "aborted":
                    self._end_ns = min(self._end_ns, t_ns + ns_from_s(_AFTER_ABORT_S))
            if s_from_ns(t_ns) >= said_s:
                said_s += _PROGRESS_EVERY_S
                self._sink(StageAdvanced(STAGE, round(s_from_ns(t_ns)), self._command.mode))
        facts: dict[str, object] = {"late_count": self._late_count}
        if self._command.mode == "aborted":
            self._writer.close("aborted", f"no pose for {self._scenario.law.abort_s:g} s", facts)
        else:
            self._writer.close("completed", "", facts)
        self._sink(StageFinished(STAGE, f"{s_from_ns(self._end_ns):.1f} s, {self._command.mode} at the end"))

    def _expose(self, t_ns: int, index: int) -> tuple[int, _Answer]:
        """Take one capture and solve it; when the answer is ready, and the answer."""
        world, set_up = self._world, self._set_up
        seen_ns = t_ns + self._exposure_ns
        world.link.state_at(seen_ns)
        world.scene.look(t_ns)
        is_dropped = bool(self._rng.random() < set_up.faults.drop)
        pose, reason, beacon = None, DROPPED, ""
        processing_ns = ns_from_s(set_up.processing_s)
        if not is_dropped and t_ns < self._busy_until_ns:
            reason = BUSY
        elif not is_dropped:
            began_ns = 0 if self._clock is None else self._clock.now_ns()
            pose, reason, beacon = self._solve(t_ns, index)
            if self._clock is not None:
                processing_ns = round((self._clock.now_ns() - began_ns) / (1.0 - set_up.faults.cpu))
            self._busy_until_ns = seen_ns + processing_ns
        middle_ns = t_ns + self._exposure_ns // 2
        answer = _Answer(
            index=index,
            t_ns=middle_ns,
            pose=pose,
            reason=reason,
            beacon=beacon,
            hue=str(world.scene.hue_at(t_ns)),
            leader=world.scene.leader_at(middle_ns).pose,
            body=world.link.state_at(middle_ns).world_from_body,
            calm_s=calm_s(world.leader, s_from_ns(middle_ns)),
            place=world.leader.state_at(s_from_ns(middle_ns)).place,
        )
        return seen_ns + processing_ns + ns_from_s(set_up.faults.latency_s), answer

    def _solve(self, t_ns: int, index: int) -> tuple[RelativePose | None, str, str]:
        """Pixels to a relative pose, or the reason why not, and the beacon believed."""
        capture = self._world.camera.capture_at(t_ns, index)
        outcomes = solve_all(capture, self._sensors, self._priors)
        self._priors = {name: o for name, o in outcomes.items() if isinstance(o, PoseEstimate)}
        handed = hand_over(outcomes, self._handover, self._policy, capture.t_ns)
        self._handover = handed.state
        if handed.switched and len(self._sensors) > 1:
            self._sink(Remark("info", f"{s_from_ns(t_ns):.2f} s: {handed.active} is active ({handed.switched})"))
        found = handed.answer
        if isinstance(found, PoseEstimate):
            return relative_pose(found, self._scenario.body_from_camera()), "", handed.active or ""
        return None, _reason(outcomes, handed.active), handed.active or ""

    def _obey(self, t_ns: int, answer: _Answer) -> None:
        """Filter, law, motion, and one line of the record."""
        accepted = False
        reason = answer.reason
        if answer.pose is not None:
            self._memory, accepted = take_pose(self._memory, answer.pose, self._scenario.filter)
            reason = "" if accepted else OUTLIER
        line = smoothed(self._memory, self._scenario.filter)
        self._command = follow_step(self._command, line, accepted, t_ns, self._station, self._scenario.law)
        self._world.link.send(self._command)
        command = self._command
        self._writer.append(
            FollowCycle(
                index=answer.index,
                t_ns=answer.t_ns,
                answer_t_ns=t_ns,
                leader=answer.leader,
                body=answer.body,
                sensed=None if answer.pose is None else answer.pose.leader_from_body,
                sigma_m=np.full(3, np.nan) if answer.pose is None else np.sqrt(np.diag(answer.pose.covariance)[3:]),
                is_accepted=accepted,
                reason=reason,
                beacon=answer.beacon,
                hue=answer.hue,
                mode=command.mode,
                age_s=command.age_s,
                velocity_mps=command.velocity_mps,
                acceleration_mps2=command.acceleration_mps2,
                rate_radps=command.rate_radps,
                calm_s=answer.calm_s,
                place=answer.place,
            )
        )


def _reason(outcomes: dict[str, Outcome], active: str | None) -> str:
    outcome = outcomes[active] if active in outcomes else next(iter(outcomes.values()))
    return "" if isinstance(outcome, PoseEstimate) else f"{outcome.stage}/{outcome.reason}"
