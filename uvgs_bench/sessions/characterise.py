"""Leading a self-test of the gantry: where to go for each test, and one reading of an instrument at every visit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol, get_args

import numpy as np

from uvgs_bench.camera.boards import Board, BoardMiss, BoardView, find_board
from uvgs_bench.devices.cameras.source import CameraSource
from uvgs_bench.devices.clock import Clock
from uvgs_bench.devices.gantry.axes import Axis, Envelope
from uvgs_bench.devices.gantry.gantry import Gantry
from uvgs_bench.errors import CaptureError, ConfigError, EnvelopeError, GantryLost
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sessions.events import EventSink, Remark, StageAdvanced, StageFinished, StageStarted, ignore_events
from uvgs_bench.sessions.interruption import check_interruption
from uvgs_bench.units import m_from_mm, ns_from_s, s_from_ns

Test = Literal["still", "positioning", "reversal", "drift", "homing", "squareness"]
TESTS: tuple[Test, ...] = get_args(Test)
DIAL_TESTS: tuple[Test, ...] = ("positioning", "reversal", "homing")
"""What can be read off a dial gauge, one axis at a time. A camera needs ``still`` for all the others."""

# Uneven places on the unit interval, so that errors that repeat along a screw show.
_UNEVEN = 0.382
# Places of the grid are drawn to the ends of travel, where scale and squareness show most.
_TO_THE_ENDS = 0.35
_OVERSHOOT_M = 1e-3
_MOST_OLD = 100
_FEWEST_CORNERS = 6


@dataclass(frozen=True, slots=True)
class Options:
    """What is tested, and how much.

    Args:
        tests: Which tests.
        axis: Letter of the one axis to test, or empty for all linear ones.
        targets: Targets along each axis for the positioning test.
        runs: Approaches of each target from each side; homing cycles for the homing test.
        reversal_span_m: Way to and fro of the reversal test, m; more than twice the backlash.
        reversal_steps: Steps on half of that way.
        reversal_cycles: How often to and fro.
        captures: Pictures whose corners are averaged at each visit; a dial gauge is read once.
        grid: Places along each linear axis for scale and squareness; one that is missing takes the last.
        margin_m: Distance kept from the ends of travel, m.
        speed_mps: Speed of all moves, m/s; 0 is as fast as every axis may.
        settle_s: Wait between arrival and reading, s.
    """

    tests: tuple[Test, ...] = TESTS
    axis: str = ""
    targets: int = 5
    runs: int = 5
    reversal_span_m: float = 8e-4
    reversal_steps: int = 8
    reversal_cycles: int = 4
    captures: int = 8
    grid: tuple[int, ...] = (4, 4, 4)
    margin_m: float = 0.02
    speed_mps: float = 0.0
    settle_s: float = 0.2

    def __post_init__(self) -> None:
        if self.targets < 2 or self.runs < 2 or self.reversal_steps < 2 or self.reversal_cycles < 1:
            raise ConfigError("a characterisation needs 2 targets, 2 runs, 2 reversal steps and a cycle or more")
        if self.captures < 1:
            raise ConfigError(f"a visit needs a capture or more, got {self.captures}")
        if not (self.reversal_span_m > 0.0 and self.margin_m >= 0.0 and self.settle_s >= 0.0 and self.speed_mps >= 0.0):
            raise ConfigError("spans must be positive; margin, settling and speed must not be negative")


@dataclass(frozen=True, slots=True, eq=False)
class Visit:
    """One place to read the instrument at.

    Args:
        test: What it is for.
        axis: Index of the axis under test, or -1 for none.
        position: Machine axis positions, shape (A,), m or rad.
        path: Positions on the way, the place itself last.
        target: Number of the target along the axis.
        run: Number of the run.
        is_from_above: Whether it is approached moving downwards.
        homes_first: Whether the gantry is homed before.
    """

    test: Test
    axis: int
    position: FloatArray
    path: tuple[FloatArray, ...]
    target: int = 0
    run: int = 0
    is_from_above: bool = False
    homes_first: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What the instrument said at a visit.

    Args:
        visit: The visit.
        t_s: Bench time since the first reading, s.
        position: Machine axis positions the controller reported, shape (A,), m or rad.
        view: The board as the camera saw it, or None.
        along_m: Reading of a dial gauge along the axis, m, or None.
    """

    visit: Visit
    t_s: float
    position: FloatArray
    view: BoardView | None = None
    along_m: float | None = None


class Instrument(Protocol):
    """What judges the gantry."""

    name: str

    def read(self, visit: Visit, settled_ns: int) -> BoardView | float | None:
        """A board view, a length along the axis in m, or None when nothing could be read."""
        ...


class BoardCamera:
    """A live camera that looks at a board on the carriage (or, riding on it, at a board that stands).

    Args:
        camera: The camera.
        board: The board.
        captures: Pictures averaged at each visit.
    """

    def __init__(self, camera: CameraSource, board: Board, captures: int = 1) -> None:
        self.name = f"camera {camera.spec} with board {board.name}"
        self._camera = camera
        self._board = board
        self._captures = captures

    def read(self, visit: Visit, settled_ns: int) -> BoardView | float | None:
        """The board in pictures exposed after settling, None when half of them do not show it. Raises CaptureError."""
        captures = [self._fresh(settled_ns) for _ in range(self._captures)]
        found = [find_board(capture.image, self._board, capture.source) for capture in captures]
        views = [view for view in found if not isinstance(view, BoardMiss)]
        return average_view(views) if 2 * len(views) > len(found) else None

    def _fresh(self, settled_ns: int) -> Capture:
        for _ in range(_MOST_OLD):
            capture = self._camera.grab()
            if capture is None:
                raise CaptureError("the camera ended in the middle of a characterisation", self._camera.spec)
            if capture.t_ns - ns_from_s(0.5 * (capture.exposure_s or 0.0)) >= settled_ns:
                return capture
        raise CaptureError("the camera delivers old pictures only; is it live?", self._camera.spec)


def average_view(views: Sequence[BoardView]) -> BoardView | None:
    """Corners averaged over pictures of a board at rest.

    Args:
        views: The pictures, one or more.

    Returns:
        The first, with the mean of every corner that all of them show; None when fewer than ``_FEWEST_CORNERS`` are.
    """
    places = [{tuple(point): px for point, px in zip(v.board_m, v.px, strict=True)} for v in views]
    kept = [point for point in places[0] if all(point in each for each in places)]
    if len(kept) < _FEWEST_CORNERS:
        return None
    px = np.mean([[each[point] for point in kept] for each in places], axis=0)
    return replace(views[0], px=read_only(px), board_m=read_only(np.array(kept)))


class DialGauge:
    """A gauge that a person reads.

    Args:
        ask: Shows a line and returns the reading, mm, larger when the axis moves upwards.
    """

    name = "dial gauge, read by a person"

    def __init__(self, ask: Callable[[str], float]) -> None:
        self._ask = ask

    def read(self, visit: Visit, settled_ns: int) -> BoardView | float | None:
        """What the person typed, m."""
        way = "above" if visit.is_from_above else "below"
        what = f"{visit.test}, run {visit.run + 1}, target {visit.target + 1} from {way}"
        return m_from_mm(self._ask(what))


def plan_visits(envelope: Envelope, options: Options) -> tuple[Visit, ...]:
    """All visits in order, each checked against the envelope.

    Args:
        envelope: What may be reached.
        options: What is tested.

    Returns:
        The visits.

    Raises:
        ConfigError: No such axis, or no room between the margins.
        EnvelopeError: A place or way meets a keep-out box.
    """
    axes = envelope.axes
    linear = [i for i, axis in enumerate(axes) if axis.kind == "linear"]
    tested = [i for i in linear if options.axis in ("", axes[i].name)]
    if not tested:
        names = " ".join(axes[i].name for i in linear)
        raise ConfigError(f"no linear axis {options.axis!r}, the bench has {names or 'none'}")
    planner = _Planner(axes, linear, options)
    visits: list[Visit] = []
    for test in TESTS:
        if test in options.tests:
            visits += planner.visits(test, tested)
    at: FloatArray | None = None
    for visit in visits:
        for position in visit.path:
            try:
                envelope.check_point(position)
                if at is not None and not visit.homes_first:
                    envelope.check_path(at, position)
            except EnvelopeError as error:
                raise EnvelopeError(f"{visit.test}: {error}", error.axis) from None
            at = position
    return tuple(visits)


class _Planner:
    def __init__(self, axes: Sequence[Axis], linear: list[int], options: Options) -> None:
        self._options = options
        self._linear = linear
        self._low, self._high = np.zeros(len(axes)), np.zeros(len(axes))
        self._step = np.zeros(len(axes))
        for i in linear:
            self._step[i] = max(_OVERSHOOT_M, 2.0 * axes[i].backlash)
            margin = options.margin_m + self._step[i]
            self._low[i], self._high[i] = axes[i].lower + margin, axes[i].upper - margin
            if not self._high[i] - self._low[i] > 2.0 * options.reversal_span_m:
                raise ConfigError(f"axis {axes[i].name} has no room between margins of {margin:g} m")
        for i, axis in enumerate(axes):
            if axis.kind == "rotary":
                # Turned off its zero, a rotary axis would turn the directions of the others.
                self._low[i] = self._high[i] = min(max(0.0, axis.lower), axis.upper)
        self._middle = read_only(0.5 * (self._low + self._high))

    def visits(self, test: Test, tested: list[int]) -> list[Visit]:
        if test == "still":
            still = self._visit("still", -1, self._middle, -1.0)
            again = [Visit("still", -1, self._middle, (self._middle,), run=k) for k in range(1, 10)]
            # From end to end of every axis, so that a camera knows which way each goes.
            ends = [self._along(i, end[i]) for i in self._linear for end in (self._low, self._high)]
            return [still, *again, *(self._visit("still", -1, place, -1.0, target=1) for place in ends)]
        if test == "drift":
            # Where an axis is tested, the visits between do.
            count = 0 if {"positioning", "reversal"} & set(self._options.tests) else 2 * self._options.runs
            return [self._visit("drift", -1, self._middle, -1.0, run=k) for k in range(count)]
        if test == "homing":
            return [
                self._visit("homing", tested[0] if len(tested) == 1 else -1, self._middle, -1.0, run=k, homes=True)
                for k in range(self._options.runs)
            ]
        if test == "squareness":
            return [self._visit("squareness", -1, place, -1.0, target=k) for k, place in enumerate(self._grid())]
        out: list[Visit] = []
        for i in tested:
            out += self._positioning(i) if test == "positioning" else self._reversal(i)
            if "drift" in self._options.tests:
                out.append(self._visit("drift", -1, self._middle, -1.0, run=len(out)))
        return out

    def _visit(
        self,
        test: Test,
        axis: int,
        place: FloatArray,
        side: float,
        *,
        target: int = 0,
        run: int = 0,
        homes: bool = False,
    ) -> Visit:
        beside = read_only(place + side * self._step)
        return Visit(test, axis, read_only(place), (beside, read_only(place)), target, run, side > 0.0, homes)

    def _along(self, axis: int, value: float) -> FloatArray:
        place = np.array(self._middle)
        place[axis] = value
        return read_only(place)

    def _positioning(self, axis: int) -> list[Visit]:
        n, low, high = self._options.targets, self._low[axis], self._high[axis]
        share = (np.arange(n) + _UNEVEN * np.sin(2.4 * np.arange(n)) * 0.5) / (n - 1)
        share = (share - share[0]) / (share[-1] - share[0])
        targets = low + (high - low) * share
        out: list[Visit] = []
        for run in range(self._options.runs):
            for is_from_above in (False, True):
                numbers = range(n)[::-1] if is_from_above else range(n)
                side = 1.0 if is_from_above else -1.0
                for first, k in enumerate(numbers):
                    place = self._along(axis, targets[k])
                    beside = np.array(place)
                    beside[axis] += side * self._step[axis]
                    path = (read_only(beside), place) if first == 0 else (place,)
                    out.append(Visit("positioning", axis, place, path, k, run, is_from_above))
        return out

    def _reversal(self, axis: int) -> list[Visit]:
        n, half = self._options.reversal_steps, 0.5 * self._options.reversal_span_m
        cycle = [*range(n + 1), *range(n - 1, -n - 1, -1), *range(-n + 1, 0)]
        out: list[Visit] = []
        for run in range(self._options.reversal_cycles):
            for k, step in enumerate(cycle):
                place = self._along(axis, self._middle[axis] + half * step / n)
                beside = np.array(place)
                beside[axis] -= self._step[axis]
                path = (read_only(beside), place) if run == 0 and k == 0 else (place,)
                out.append(Visit("reversal", axis, place, path, k, run))
        return out

    def _grid(self) -> list[FloatArray]:
        counts = self._options.grid
        steps = [np.array([value]) for value in self._middle]
        for order, i in enumerate(self._linear):
            share = np.linspace(-1.0, 1.0, counts[min(order, len(counts) - 1)])
            share = np.sign(share) * np.abs(share) ** _TO_THE_ENDS
            steps[i] = self._middle[i] + 0.5 * (self._high[i] - self._low[i]) * share
        return [read_only(place) for place in np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(-1, len(steps))]


def take_readings(
    visits: Sequence[Visit],
    gantry: Gantry,
    instrument: Instrument,
    clock: Clock,
    options: Options,
    *,
    sink: EventSink = ignore_events,
) -> tuple[Reading, ...]:
    """Home, make every visit, and read the instrument at each.

    Args:
        visits: As planned.
        gantry: The open gantry.
        instrument: What reads.
        clock: Bench time.
        options: Speed and settling.
        sink: Receives progress.

    Returns:
        The readings; visits at which nothing could be read are left out.

    Raises:
        GantryError: A move failed, or the position cannot be trusted.
        CaptureError: The camera failed.
        KeyboardInterrupt: The user stopped it.
    """
    linear = [axis.max_speed for axis in gantry.axes if axis.kind == "linear"]
    speed = options.speed_mps or min(linear)
    sink(StageStarted("homing", 1))
    gantry.home()
    sink(StageFinished("homing", "position known"))
    sink(StageStarted("characterise", len(visits)))
    out: list[Reading] = []
    begun_ns, missed = clock.now_ns(), 0
    for number, visit in enumerate(visits, start=1):
        check_interruption()
        if visit.homes_first:
            gantry.home()
        for position in visit.path:
            check_interruption()
            gantry.move_to(position, speed)
        clock.sleep(options.settle_s)
        state = gantry.state()
        if not state.is_trusted:
            raise GantryLost(f"the position cannot be trusted: the controller says {state.activity}", gantry.port)
        said = instrument.read(visit, clock.now_ns())
        t_s = s_from_ns(clock.now_ns() - begun_ns)
        if said is None:
            missed += 1
        elif isinstance(said, BoardView):
            out.append(Reading(visit, t_s, state.position, view=said))
        else:
            out.append(Reading(visit, t_s, state.position, along_m=float(said)))
        sink(StageAdvanced("characterise", number, f"{visit.test} {number} of {len(visits)}"))
    if missed:
        sink(Remark("warning", f"{missed} of {len(visits)} visits gave no reading"))
    sink(StageFinished("characterise", f"{len(out)} readings"))
    return tuple(out)
