"""Lead a source of captures through the sensor: live, from files, or from the pictures kept in a run."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from uvgs_bench.devices.cameras.images import read_image
from uvgs_bench.errors import ConfigError, RunError
from uvgs_bench.interop.trajectories import LineNote
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.difference import Difference, DifferenceConfig, difference_pairs
from uvgs_bench.sensor.exposure import ExposureAdvice, clipped_leds
from uvgs_bench.sensor.handover import HandoverPolicy, HandoverState, Held, hand_over, solve_all
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate
from uvgs_bench.sensor.pace import Pace
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.events import EventSink, Remark, StageAdvanced, StageFinished, StageStarted
from uvgs_bench.sessions.exposure_loop import ExposureLoop
from uvgs_bench.sessions.interruption import check_interruption
from uvgs_bench.sessions.light_ranges import ClipWatch
from uvgs_bench.sessions.stream_health import StreamHealth
from uvgs_bench.store.run import Run

STAGE = "solve"
# A published pose whose margin is below so many times the least one is said to be near to ambiguous.
_LOW_MARGIN = 2.0


@dataclass(frozen=True, slots=True)
class StreamRules:
    """How captures are led through the sensors.

    Args:
        limit: Stop after so many captures, or None.
        track: Hand each sensor its last pose as a prior while there is one; without it the answer depends on the
            picture alone.
        threads: How many threads OpenCV may use; the compiled kernels always use one, so 1 is deterministic real time.
        handover: Which beacon is active, and how long its last pose is held.
        active: Beacon that is active from the first capture on, or None.
        difference: Take every second capture from its neighbour, for a switched light; None solves each capture.
    """

    limit: int | None = None
    track: bool = False
    threads: int = 1
    handover: HandoverPolicy = field(default_factory=lambda: HandoverPolicy(hold_s=0.0))
    active: str | None = None
    difference: DifferenceConfig | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Answered:
    """What one capture yielded.

    Args:
        capture: The capture, or the difference of two.
        outcomes: The fresh outcome of each beacon.
        lines: What is to be written for each beacon: its outcome, or the held pose of the active one; and its note.
        active: Name of the active beacon; None while none was ever seen.
    """

    capture: Capture
    outcomes: dict[str, Outcome]
    lines: dict[str, tuple[Outcome | Held, LineNote]]
    active: str | None


def solve_source(
    source: Iterable[Capture],
    sensors: Mapping[str, Uvgs],
    sink: EventSink,
    rules: StreamRules | None = None,
    *,
    total: int | None = None,
    exposure: ExposureLoop | None = None,
    command: Callable[[], str | None] | None = None,
    flags_of: Callable[[Capture], tuple[str, ...]] | None = None,
    is_live: bool = False,
) -> Iterator[Answered]:
    """Solve captures for every beacon.

    Args:
        source: Captures, an open camera source for example.
        sensors: One sensor per beacon, by the beacon's name.
        sink: Where progress and warnings go.
        rules: How; each capture by itself when None.
        total: Number of captures if known.
        exposure: The exposure loop of the source's camera, or None.
        command: Asked before every capture for the beacon to use from now on; None means no change.
        flags_of: What the source has to say about a capture, in flags of its lines.
        is_live: Whether the captures are taken now.

    Yields:
        Each capture with its outcomes.

    Raises:
        CaptureError: The source fails.
        CalibrationError: A picture has another size than the calibration.
        ConfigError: ``rules.active`` is none of the beacons.
    """
    how = StreamRules() if rules is None else rules
    if how.active is not None and how.active not in sensors:
        raise ConfigError(f"unknown beacon '{how.active}', expected one of: {', '.join(sensors)}", "--active")
    if how.difference is not None and total is not None:
        total //= 2
    known = [n for n in (total, how.limit) if n is not None]
    sink(StageStarted(STAGE, min(known) if known else None))
    watch = ClipWatch(sensors, sink, None if exposure is None else exposure.policy.shortest_s)
    health = StreamHealth(sink, is_live=is_live)
    state, wanted = HandoverState(), how.active
    priors: dict[str, PoseEstimate] = {}
    pace = Pace(max((sensor.config.rate_hz for sensor in sensors.values()), default=0.0))
    count = poses = 0
    if how.limit is None or how.limit > 0:
        for capture, pair in _captures(source, how.difference):
            check_interruption()
            if not pace.takes(capture.t_ns):
                continue
            _limit_threads(how.threads)
            outcomes = solve_all(capture, sensors, priors)
            if pair is not None:
                outcomes = {name: _trusted(outcome, pair) for name, outcome in outcomes.items()}
            if how.track:
                priors = {name: outcome for name, outcome in outcomes.items() if isinstance(outcome, PoseEstimate)}
            watch.look(capture, outcomes)
            flags = (*health.look(capture, outcomes), *(() if flags_of is None else flags_of(capture)))
            advice = None if exposure is None else exposure.after(capture, outcomes)
            wanted = _command(command, sensors, sink) or wanted
            handed = hand_over(outcomes, state, how.handover, capture.t_ns, wanted)
            state, wanted = handed.state, None
            if handed.switched and len(sensors) > 1:
                sink(Remark("info", f"capture {capture.index}: {handed.active} is active ({handed.switched})"))
            lines: dict[str, tuple[Outcome | Held, LineNote]] = {}
            for name, outcome in outcomes.items():
                is_active = len(sensors) == 1 or name == handed.active
                held = handed.answer if is_active and isinstance(handed.answer, Held) else None
                switched = handed.switched if is_active and len(sensors) > 1 else ""
                note = _note(capture, outcome, sensors[name], is_active, switched, advice, flags)
                lines[name] = (outcome if held is None else held, note)
            count += 1
            poses += any(isinstance(outcome, PoseEstimate) for outcome in outcomes.values())
            sink(StageAdvanced(STAGE, count, capture.source))
            yield Answered(capture, outcomes, lines, handed.active)
            if how.limit is not None and count >= how.limit:
                break
    sink(StageFinished(STAGE, f"{poses} of {count} captures with a pose"))


def _captures(source: Iterable[Capture], rules: DifferenceConfig | None) -> Iterator[tuple[Capture, Difference | None]]:
    if rules is None:
        for capture in source:
            yield capture, None
        return
    for pair in difference_pairs(source, rules):
        yield pair.capture, pair


def _trusted(outcome: Outcome, pair: Difference) -> Outcome:
    """The outcome, or a miss when the pair was no pair: what moved between two lit captures fits as well as LEDs do."""
    if isinstance(outcome, Miss) or pair.is_switched_at(outcome.led_px):
        return outcome
    return Miss(
        "preprocess",
        "pair_not_switched",
        "the dark capture is not dark around the LEDs: a capture was lost, or the light is not switched",
        outcome.t_ns,
        outcome.beacon,
        outcome.blob_count,
        outcome.stage_s,
    )


def _command(command: Callable[[], str | None] | None, sensors: Mapping[str, Uvgs], sink: EventSink) -> str | None:
    name = None if command is None else command()
    if name is None or name in sensors:
        return name
    sink(Remark("warning", f"unknown beacon '{name}', expected one of: {', '.join(sensors)}"))
    return None


def _note(
    capture: Capture,
    outcome: Outcome,
    uvgs: Uvgs,
    is_active: bool,
    switched: str,
    advice: ExposureAdvice | None,
    told: tuple[str, ...],
) -> LineNote:
    flags = list(told)
    if isinstance(outcome, PoseEstimate):
        if clipped_leds(capture, outcome):
            flags.append("saturated")
        if outcome.margin < _LOW_MARGIN * uvgs.config.min_margin:
            flags.append("low_margin")
    if advice is None:
        return LineNote(tuple(flags), is_active, switched)
    return LineNote(tuple(flags), is_active, switched, advice.exposure_s, f"{advice.reason}: {advice.detail}")


def _limit_threads(threads: int) -> None:
    """Tell OpenCV, once something has loaded it; loading it only for this would cost its memory."""
    cv2 = sys.modules.get("cv2")
    if cv2 is not None and cv2.getNumThreads() != threads:
        cv2.setNumThreads(threads)


def run_captures(run: Run) -> list[tuple[int, str]]:
    """Which pictures of a run are kept.

    Args:
        run: The run.

    Returns:
        Position in ``run.samples`` and picture file of each, in order.

    Raises:
        RunError: None is kept, or the run was taken of several beacons.
    """
    if run.has_several_beacons:
        raise RunError(
            "was taken of several beacons: which one a picture shows was known from the gantry alone, so its pictures "
            "are not solved again",
            str(run.path),
        )
    kept = [(i, sample.capture_file) for i, sample in enumerate(run.samples) if sample.capture_file]
    if not kept:
        raise RunError(
            "no picture of this run is kept, so it cannot be solved again (sweep with --keep all)", str(run.path)
        )
    return kept


def read_run_captures(run: Run) -> Iterator[Capture]:
    """The kept pictures of a run as captures with their recorded instants.

    Args:
        run: The run.

    Yields:
        Captures; ``source`` is the picture's file within the run, ``index`` the sample's.

    Raises:
        RunError: No picture is kept.
        CaptureError: A picture cannot be read.
    """
    for position, name in run_captures(run):
        sample = run.samples[position]
        yield Capture(read_image(run.path / name), sample.t_ns, name, sample.index)
