"""Leading the measurement of a beacon: name the blobs of pictures, adjust, name them again with the better beacon."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import islice

import numpy as np

from uvgs_bench import __version__
from uvgs_bench.beacon import Beacon
from uvgs_bench.beacon.checks import size_m
from uvgs_bench.beacon.frames import FrameChoice, place
from uvgs_bench.beacon.measure import BeaconMeasurement, LedView, MeasureConfig, measure_beacon
from uvgs_bench.camera.boards import Board, BoardView, find_board, is_worth_a_search, symmetry
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.devices.cameras.registry import open_camera
from uvgs_bench.devices.gantry.axes import gantry_from_carriage
from uvgs_bench.errors import CaptureError, ConfigError, RunError, TooFewViews
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.sensor.blobs import NoBlobs, find_blobs
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.outcome import PoseEstimate
from uvgs_bench.sensor.selection import select_blobs
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.sessions.events import EventSink, Remark, StageAdvanced, StageFinished, StageStarted, ignore_events
from uvgs_bench.sessions.print_mask import without_print
from uvgs_bench.sessions.stream import read_run_captures
from uvgs_bench.store.run import Run, Sample

# Naming with a better beacon changes few names; more rounds than this do not settle.
_MAX_ROUNDS = 4
# With fewer pictures than this a second round cannot be better than the first.
_FEWEST = 4
# Where a run kept no picture its centroids are taken as equally good.
_PLAIN_SIGMA_PX = 0.1
_MOST_GLINTS = 4
# Two attitudes of the carriage are the same to this, of a rotation matrix: far below what a stop repeats to.
_SAME_TURN = 1e-9

# Each picture with the number it goes by.
Pictures = Callable[[], Iterable[tuple[int, Capture]]]


@dataclass(frozen=True, slots=True, eq=False)
class Named:
    """The named blobs of one capture.

    Args:
        led: Numbers of the LEDs seen, shape (m,).
        px: Their centres, shape (m, 2), raw px.
        sigma_px: Their deviations, shape (m,), px.
        estimate: The pose they gave.
    """

    led: np.ndarray[tuple[int], np.dtype[np.intp]]
    px: FloatArray
    sigma_px: FloatArray
    estimate: PoseEstimate


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredBeacon:
    """A measurement and how its pictures fared.

    Args:
        measurement: The measurement.
        captures: Pictures looked at.
        named_first: Pictures whose blobs could be named with the nominal beacon.
        named: Pictures whose blobs could be named in the end.
        rounds: How often the blobs were named.
        misses: Reasons of pictures not named in the end.
    """

    measurement: BeaconMeasurement
    captures: int
    named_first: int
    named: int
    rounds: int
    misses: dict[str, int]


def measure_from_pictures(
    captures: Sequence[Capture],
    nominal: Beacon,
    calibration: Calibration,
    config: MeasureConfig,
    *,
    board: Board | None = None,
    nominal_error_m: float = 2e-3,
    sensor: UvgsConfig | None = None,
    name: str = "",
    sink: EventSink = ignore_events,
) -> MeasuredBeacon:
    """Measure a beacon from pictures, free or with a board fixed to it.

    With a board, every picture that shows both is one view. Pictures that show only one of them come in pairs without
    a move between: the first with the second, the third with the fourth.

    Args:
        captures: The pictures.
        nominal: The beacon as meant.
        calibration: The camera.
        config: Source, frame, what else is known.
        board: The board fixed to the beacon, for ``by = "board"``.
        nominal_error_m: How far LEDs may be from where the nominal beacon has them, m.
        sensor: Settings of the sensor.
        name: Name of the measured beacon.
        sink: Receives progress.

    Returns:
        The measurement.

    Raises:
        TooFewViews: Too few pictures could be named, or they cannot tell.
        CalibrationError: The pictures contradict what is declared, or have another size than the calibration.
        ConfigError: A board that looks the same from several sides.
    """
    known: dict[int, BoardView | None] = {}
    if board is not None and (turn := symmetry(board)):
        raise ConfigError(
            f"board '{board.name}' looks the same after a {turn}, so no picture tells how it is fixed: "
            "use one with an odd and an even number of corners, ChArUco or AprilGrid",
            "--board",
        )

    def board_in(i: int) -> BoardView | None:
        if i not in known:
            assert board is not None
            image = captures[i].image
            found = find_board(image, board, captures[i].source) if is_worth_a_search(image, board) else None
            known[i] = found if isinstance(found, BoardView) else None
        return known[i]

    def lights() -> Iterator[tuple[int, Capture]]:
        for i, capture in enumerate(captures):
            view = None if board is None else board_in(i)
            yield i, capture if view is None else without_print(capture, view)

    def views_of(named: dict[int, Named]) -> list[LedView]:
        out = []
        for i, seen in named.items():
            label = captures[i].source or f"picture {i + 1}"
            if board is None:
                out.append(_view(label, seen))
                continue
            # The board of the next picture belongs to this pose only where this picture shows none itself.
            partner = i ^ 1
            is_pair = partner < len(captures) and partner not in named
            corners = board_in(i) or (board_in(partner) if is_pair else None)
            if corners is not None:
                out.append(_view(label, seen, board=corners))
        if board is not None:
            sink(Remark("info", f"the board and the LEDs are seen together at {len(out)} poses"))
        return out

    return _in_rounds(
        lights,
        len(captures),
        views_of,
        nominal,
        calibration,
        config,
        nominal_error_m,
        sensor,
        name,
        sink,
    )


def measure_from_run(
    run: Run,
    nominal: Beacon,
    calibration: Calibration,
    config: MeasureConfig,
    *,
    nominal_error_m: float = 2e-3,
    sensor: UvgsConfig | None = None,
    name: str = "",
    sink: EventSink = ignore_events,
) -> MeasuredBeacon:
    """Measure a beacon from the stations of a run.

    With ``by = "gantry"`` the gantry knows how far it went; where rotary axes moved, too, only stations at the attitude
    of the carriage that most have are used. With ``free`` every station is a view and the gantry is not believed.

    Args:
        run: The run; where it kept pictures they are named anew, else the names it recorded are believed.
        nominal: The beacon as meant.
        calibration: The camera.
        config: Source, ``gantry`` or ``free``, frame, and what is known.
        nominal_error_m: How far LEDs may be from where the nominal beacon has them, m.
        sensor: Settings of the sensor.
        name: Name of the measured beacon.
        sink: Receives progress.

    Returns:
        The measurement.

    Raises:
        RunError: The recorded names belong to another beacon.
        TooFewViews: Too few stations, or they cannot tell.
        CalibrationError: The stations contradict the gantry.
    """
    config = replace(config, is_carried=run.manifest.mount == "beacon_on_carriage")
    places = {sample.index: gantry_from_carriage(run.manifest.axes, sample.position) for sample in run.samples}
    if config.by == "gantry":
        run, left_out = _at_one_attitude(run, places)
        if left_out:
            said = f"{left_out} captures at other attitudes of the carriage are left out: --by free uses them"
            sink(Remark("warning", f"a rotary axis moved; {said}"))
    is_by_gantry = config.by == "gantry"
    station_of = {sample.index: sample.station for sample in run.samples}

    def views_of(named: dict[int, Named]) -> list[LedView]:
        stations: dict[int, list[int]] = {}
        for index in named:
            stations.setdefault(station_of[index], []).append(index)
        # Shots of one station share what is wrong with its picture, so their mean counts once.
        return [
            _view(
                f"station {s}",
                _mean([named[i] for i in shots]),
                carriage_m=places[shots[0]].t_m if is_by_gantry else None,
            )
            for s, shots in stations.items()
        ]

    if any(sample.capture_file for sample in run.samples):
        return _in_rounds(
            lambda: ((capture.index, capture) for capture in read_run_captures(run)),
            sum(bool(sample.capture_file) for sample in run.samples),
            views_of, nominal, calibration, config, nominal_error_m, sensor, name, sink,
        )  # fmt: skip
    if run.beacon.led_names != nominal.led_names:
        raise RunError("kept no pictures, and its LEDs are not those of the nominal beacon", str(run.path))
    sink(Remark("warning", "no picture of this run is kept: the names it recorded are believed"))
    recorded = {sample.index: seen for sample in run.samples if (seen := _recorded(sample)) is not None}
    misses = Counter(sample.reason for sample in run.samples if sample.reason)
    found = measure_beacon(views_of(recorded), nominal, calibration, config, name)
    return MeasuredBeacon(found, len(run.samples), len(recorded), len(recorded), 0, dict(misses))


def _at_one_attitude(run: Run, places: dict[int, Pose]) -> tuple[Run, int]:
    """The run with the samples at the commonest attitude of its carriage, and how many others it had."""
    groups: list[list[Sample]] = []
    for sample in run.samples:
        R = places[sample.index].R
        group = next((g for g in groups if float(np.abs(places[g[0].index].R - R).max()) < _SAME_TURN), None)
        if group is None:
            groups.append(group := [])
        group.append(sample)
    kept = max(groups, key=len, default=[])
    return replace(run, samples=tuple(kept)), len(run.samples) - len(kept)


def _recorded(sample: Sample) -> Named | None:
    outcome = sample.outcome
    if not isinstance(outcome, PoseEstimate):
        return None
    seen = np.flatnonzero(np.isfinite(outcome.led_px[:, 0]))
    return Named(seen, outcome.led_px[seen], np.full(len(seen), _PLAIN_SIGMA_PX), outcome)


def _in_rounds(
    pictures: Pictures,
    count: int,
    views_of: Callable[[dict[int, Named]], list[LedView]],
    nominal: Beacon,
    calibration: Calibration,
    config: MeasureConfig,
    nominal_error_m: float,
    sensor: UvgsConfig | None,
    name: str,
    sink: EventSink,
) -> MeasuredBeacon:
    """Name with what is known, adjust, and again until the names stay."""
    sensor = UvgsConfig() if sensor is None else sensor
    # Pictures to measure by are clean; what shows a bright board is not worth searching for LEDs.
    sensor = replace(sensor, max_blobs=min(sensor.max_blobs, len(nominal.leds) + _MOST_GLINTS))
    named, misses = _name(pictures, count, nominal, calibration, sensor, nominal_error_m, sink)
    first = len(named)
    try:
        found = measure_beacon(views_of(named), nominal, calibration, config, name)
    except TooFewViews as error:
        why = ", ".join(f"{n} x {reason}" for reason, n in misses.most_common(3))
        raise TooFewViews(f"{error}" + (f" (pictures without a pose: {why})" if why else "")) from None
    for number in range(2, _MAX_ROUNDS + 1):
        better = _in_frame_of(nominal, found.beacon)
        again, misses = _name(pictures, count, better, calibration, sensor, 0.0, sink)
        if len(again) < 0.5 * len(named):
            sink(Remark("warning", f"only {len(again)} pictures fit the measured beacon, {len(named)} the nominal one"))
        if _same_names(named, again) or len(again) < _FEWEST:
            return MeasuredBeacon(found, count, first, len(named), number, dict(misses))
        named = again
        found = measure_beacon(views_of(named), nominal, calibration, config, name)
    sink(Remark("warning", f"the names of blobs still change after {_MAX_ROUNDS} rounds"))
    return MeasuredBeacon(found, count, first, len(named), _MAX_ROUNDS, dict(misses))


def _in_frame_of(nominal: Beacon, measured: Beacon) -> Beacon:
    """The measured LEDs where the nominal ones are, so that poses of both mean the same."""
    assert measured.covariance_m2 is not None
    points, covariance = place(
        measured.positions_m, measured.covariance_m2, nominal.positions_m, FrameChoice(), nominal.led_names
    )
    leds = tuple(replace(led, position_m=p) for led, p in zip(nominal.leds, points, strict=True))
    return Beacon(measured.name, leds, nominal.hue, covariance)


def _name(
    pictures: Pictures,
    count: int,
    beacon: Beacon,
    calibration: Calibration,
    sensor: UvgsConfig,
    error_m: float,
    sink: EventSink,
) -> tuple[dict[int, Named], Counter[str]]:
    """Name the blobs of every picture; ``error_m`` is what LED positions may be wrong by."""
    stage = "name LEDs"
    sink(StageStarted(stage, count))
    plain = Uvgs(calibration, beacon, sensor)
    size = size_m(beacon)
    out: dict[int, Named] = {}
    misses: Counter[str] = Counter()
    for done, (key, capture) in enumerate(pictures(), 1):
        blobs = find_blobs(capture, sensor)
        uvgs = plain
        if error_m > 0.0 and not isinstance(blobs, NoBlobs):
            kept = select_blobs(blobs, beacon, calibration.lens.fx_px, sensor)
            if not isinstance(kept, NoBlobs):
                # Four blobs span the beacon, so they tell how many pixels a millimetre is.
                span_px = float(np.ptp(kept.centroid_px, axis=0).max())
                slack_px = float(np.hypot(sensor.model_error_px, error_m * span_px / size))
                loose = replace(sensor, model_error_px=slack_px, max_rms_px=max(sensor.max_rms_px, 2.0 * slack_px))
                uvgs = Uvgs(calibration, beacon, loose)
        outcome = uvgs.solve(capture)
        if isinstance(outcome, PoseEstimate) and not isinstance(blobs, NoBlobs):
            seen = np.flatnonzero(np.isfinite(outcome.led_px[:, 0]))
            px = outcome.led_px[seen]
            nearest = np.argmin(np.linalg.norm(px[:, None] - blobs.centroid_px[None], axis=2), axis=1)
            out[key] = Named(seen, px, blobs.sigma_px[nearest], outcome)
        elif not isinstance(outcome, PoseEstimate):
            misses[f"{outcome.stage}/{outcome.reason}"] += 1
        sink(StageAdvanced(stage, done, capture.source))
    sink(StageFinished(stage, f"{len(out)} of {count} pictures"))
    return out, misses


def _same_names(a: dict[int, Named], b: dict[int, Named]) -> bool:
    return a.keys() == b.keys() and all(
        np.array_equal(a[k].led, b[k].led) and np.array_equal(a[k].px, b[k].px) for k in a
    )


def _view(name: str, seen: Named, board: BoardView | None = None, carriage_m: FloatArray | None = None) -> LedView:
    return LedView(name, seen.led, seen.px, seen.sigma_px, seen.estimate.camera_from_beacon, board, carriage_m)


def _mean(shots: Sequence[Named]) -> Named:
    """Shots at rest as one: mean centre of each LED with the mean deviation, which is not made smaller."""
    leds = np.unique(np.concatenate([shot.led for shot in shots]))
    px, sigma = np.empty((len(leds), 2)), np.empty(len(leds))
    for row, led in enumerate(leds):
        px[row] = np.mean([shot.px[shot.led == led][0] for shot in shots if led in shot.led], axis=0)
        sigma[row] = float(np.mean([shot.sigma_px[shot.led == led][0] for shot in shots if led in shot.led]))
    return Named(leds, px, sigma, shots[0].estimate)


def read_pictures(spec: str, limit: int | None) -> list[Capture]:
    """Read every capture of a source, so that its blobs can be named more than once.

    Args:
        spec: Spec of the camera source.
        limit: At most so many; a live camera needs one.

    Returns:
        The captures.

    Raises:
        ConfigError: The spec is unknown, or a live camera has no limit.
        CaptureError: The source cannot be read, or gives no pictures.
    """
    with open_camera(spec) as source:
        if source.is_live and limit is None:
            raise ConfigError("a live camera needs a number of captures to take (--limit)", spec)
        captures = list(islice(source, limit))
    if not captures:
        raise CaptureError("gives no pictures", spec)
    return captures


def made_by() -> str:
    """When and by which version, for the head of a file."""
    return f"{datetime.now(UTC).strftime('%Y-%m-%dT%H:%M:%SZ')}, uvgs_bench {__version__}"
