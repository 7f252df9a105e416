"""``uvgs gantry characterise``: the gantry's self-test, judged by a board before the camera or by a dial gauge."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.gantry_door import Door, Setup, found, in_file_units, opened
from uvgs_bench.cli.options import Force, Quiet

if TYPE_CHECKING:
    from uvgs_bench.devices.cameras.source import CameraSource
    from uvgs_bench.sessions.characterise import Instrument, Options, Visit
    from uvgs_bench.sessions.judge_gantry import Judge
    from uvgs_bench.store.gantry_records import GantryRecord

_FIGURES = (
    ("scale", "scale_ppm", "ppm", 0),
    ("  its doubt, 1 s", "scale_sigma_ppm", "ppm", 0),
    ("bend, not corrected", "bend_mm", "mm", 3),
    ("repeatability R, both ways", "repeatability_mm", "mm", 3),
    ("repeatability R, from below", "repeatability_up_mm", "mm", 3),
    ("repeatability R, from above", "repeatability_down_mm", "mm", 3),
    ("reversal B", "reversal_mm", "mm", 3),
    ("systematic error E", "systematic_mm", "mm", 3),
    ("accuracy A", "accuracy_mm", "mm", 3),
    ("pose repeatability RP", "pose_repeatability_mm", "mm", 3),
    ("dead band", "backlash_mm", "mm", 3),
    ("  95 % from", "backlash_low_mm", "mm", 3),
    ("  95 % to", "backlash_high_mm", "mm", 3),
    ("drift", "drift_mm_per_h", "mm/h", 3),
    ("  its doubt, 1 s", "drift_sigma_mm_per_h", "mm/h", 3),
    ("homing, 1 s", "homing_mm", "mm", 3),
    ("  95 % from", "homing_low_mm", "mm", 3),
    ("  95 % to", "homing_high_mm", "mm", 3),
    ("instrument, 1 s", "instrument_mm", "mm", 3),
)


def characterise(
    door: Door,
    board: Annotated[
        Path | None, typer.Option(help="Board on the carriage (or before a camera that rides): the camera judges.")
    ] = None,
    dial: Annotated[bool, typer.Option("--dial", help="A person reads a dial gauge and types mm, one axis.")] = False,
    readings: Annotated[
        Path | None, typer.Option(help="With --dial: file of readings in mm, one a line, in place of typing.")
    ] = None,
    axis: Annotated[str, typer.Option(help="Only this axis; --dial needs one.")] = "",
    tests: Annotated[
        str, typer.Option(help="Of still, positioning, reversal, drift, homing, squareness.  [default: all]")
    ] = "",
    targets: Annotated[int, typer.Option(min=2, help="Targets along each axis.")] = 5,
    runs: Annotated[int, typer.Option(min=2, help="Approaches from each side; homing cycles.")] = 5,
    reversal_span_mm: Annotated[
        float, typer.Option(min=0.01, help="Way to and fro of the reversal test; over twice the backlash.")
    ] = 0.8,
    grid: Annotated[str, typer.Option(help="Places per axis for scale and squareness.")] = "4x4x4",
    captures: Annotated[int, typer.Option(min=1, help="Pictures averaged at each visit.")] = 8,
    margin_mm: Annotated[float, typer.Option(min=0.0, help="Distance kept from the ends of travel.")] = 20.0,
    settle_s: Annotated[float, typer.Option(min=0.0, help="Wait before each reading.")] = 0.2,
    camera: Annotated[Path | None, typer.Option(help="Camera calibration in place of the bench's.")] = None,
    camera_source: Annotated[str | None, typer.Option(help="Camera in place of the bench's, like uvc:0.")] = None,
    board_sigma_ppm: Annotated[
        float | None, typer.Option(min=0.0, help="How well the board's printed size is known, 1 s.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="File to write.  [default: gantries/NAME.toml beside the bench file]")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List the visits, move nothing.")] = False,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Test how well the gantry itself positions, and write it down with its doubts.

    After ISO 230-2 and ISO 9283: repeatability from one and both sides, reversal, drift, homing; and, from a board on
    the carriage, scale and squareness. Name the file as gantry.calibration in the bench file and every later run
    uses it. The sensor under test takes no part.
    """
    from uvgs_bench.cli.console import print_path, progress_sink
    from uvgs_bench.errors import ConfigError
    from uvgs_bench.sessions.characterise import plan_visits, take_readings
    from uvgs_bench.sessions.judge_gantry import judge_gantry
    from uvgs_bench.store.gantry_records import write_gantry_record
    from uvgs_bench.store.run_writer import utc_now

    if dial == (board is not None):
        raise ConfigError("name the judge: --board FILE for a camera, or --dial for a gauge")
    if readings is not None and not dial:
        raise ConfigError("readings are typed values of a dial gauge: add --dial", key="--readings")
    options = _options(tests, axis, targets, runs, reversal_span_mm, captures, grid, margin_mm, settle_s, is_dial=dial)
    with found(door) as setup:
        visits = plan_visits(setup.bench.envelope, options)
        if dry_run:
            _print_visits(setup, visits, as_json=door.as_json)
            return
        path = out or Path(setup.bench.path).parent / "gantries" / f"{setup.bench.name}.toml"
        if path.exists() and not force:
            raise ConfigError("exists already; replace it with --force", str(path))
        with (
            _instrument(setup, board, camera, camera_source, readings, len(visits), captures) as (instrument, judge),
            opened(setup) as gantry,
            progress_sink(quiet=quiet) as sink,
        ):
            taken = take_readings(visits, gantry, instrument, setup.clock, options, sink=sink)
        if board_sigma_ppm is not None:
            from dataclasses import replace

            judge = replace(judge, board_sigma=1e-6 * board_sigma_ppm)
        axes = setup.bench.nominal_axes
        record = judge_gantry(taken, axes, judge, options, setup.bench.name, utc_now())
    try:
        write_gantry_record(path, record, force=force)
    finally:
        # An hour of measuring is shown even where it cannot be written.
        _print_record(record, path, as_json=door.as_json)
    if not door.as_json:
        print_path("gantry", path)


def _options(
    tests: str,
    axis: str,
    targets: int,
    runs: int,
    reversal_span_mm: float,
    captures: int,
    grid: str,
    margin_mm: float,
    settle_s: float,
    *,
    is_dial: bool,
) -> Options:
    from uvgs_bench.errors import ConfigError
    from uvgs_bench.sessions.characterise import DIAL_TESTS, TESTS, Options
    from uvgs_bench.units import m_from_mm

    possible = DIAL_TESTS if is_dial else TESTS
    named = [word for word in tests.replace(",", " ").split() if word] or list(possible)
    for word in named:
        if word not in possible:
            raise ConfigError(f"expected some of {', '.join(possible)}, got {word!r}", key="--tests")
    if is_dial and not axis:
        raise ConfigError("a dial gauge touches one axis: say which", key="--axis")
    try:
        counts = tuple(int(word) for word in grid.lower().split("x"))
    except ValueError:
        counts = ()
    if not counts or min(counts) < 2:
        raise ConfigError(f"expected numbers of 2 or more like 4x4x4, got {grid!r}", key="--grid")
    return Options(
        tests=tuple(test for test in TESTS if test in named or (test == "still" and not is_dial)),
        axis=axis.upper(),
        targets=targets,
        runs=runs,
        reversal_span_m=m_from_mm(reversal_span_mm),
        # A person reads fewer steps than a camera.
        reversal_steps=4 if is_dial else 8,
        reversal_cycles=1 if is_dial else 4,
        captures=captures,
        grid=counts,
        margin_m=m_from_mm(margin_mm),
        settle_s=settle_s,
    )


@contextmanager
def _instrument(
    setup: Setup,
    board: Path | None,
    camera: Path | None,
    camera_source: str | None,
    readings: Path | None,
    count: int,
    captures: int,
) -> Iterator[tuple[Instrument, Judge]]:
    from uvgs_bench.sessions.characterise import BoardCamera, DialGauge
    from uvgs_bench.sessions.judge_gantry import Judge

    bench = setup.bench
    if board is None:
        gauge = DialGauge(_asking() if readings is None else _reading_from(readings, count))
        yield gauge, Judge(gauge.name)
        return
    from uvgs_bench.devices.cameras.registry import open_camera
    from uvgs_bench.store.boards import read_board
    from uvgs_bench.store.calibrations import read_calibration

    declared, calibration = read_board(board), read_calibration(camera or Path(bench.camera_file))
    source = camera_source or bench.camera_source
    if setup.twin is not None and source == "sim:":
        from uvgs_bench.devices.sim.carried_board import CarriedBoard

        opened_camera: CameraSource = CarriedBoard(setup.twin, declared)
    else:
        opened_camera = open_camera(source, clock=setup.clock)
    with opened_camera as live:
        judge = BoardCamera(live, declared, captures)
        yield judge, Judge(judge.name, calibration, bench.mount)


def _asking() -> Callable[[str], float]:
    from uvgs_bench.errors import ConfigError

    def ask(what: str) -> float:
        while True:
            sys.stderr.write(f"{what}: mm? ")
            sys.stderr.flush()
            line = sys.stdin.readline()
            if not line:
                raise ConfigError("the readings ended before the visits did")
            try:
                return float(line)
            except ValueError:
                sys.stderr.write("a number in mm, please\n")

    return ask


def _reading_from(path: Path, count: int) -> Callable[[str], float]:
    from uvgs_bench.errors import ConfigError, UnreadableDocument

    try:
        lines = [line.split("#")[0].strip() for line in path.read_text(encoding="utf-8").splitlines()]
    except OSError as error:
        raise UnreadableDocument(f"cannot be read: {error.strerror or error}", str(path)) from None
    lines = [line for line in lines if line]
    if len(lines) != count:
        raise ConfigError(f"has {len(lines)} readings, the plan has {count} visits (see --dry-run)", str(path))
    try:
        values = iter([float(line) for line in lines])
    except ValueError as error:
        raise ConfigError(f"every line is a number in mm: {error}", str(path)) from None
    return lambda _what: next(values)


def _print_visits(setup: Setup, visits: Sequence[Visit], *, as_json: bool) -> None:
    from uvgs_bench.cli.console import emit_json, out

    axes = setup.bench.envelope.axes
    rows = [
        {
            "visit": number,
            "test": visit.test,
            "axis": axes[visit.axis].name if visit.axis >= 0 else "",
            "approach": "from above" if visit.is_from_above else "from below",
            "position": in_file_units(axes, visit.position),
        }
        for number, visit in enumerate(visits, start=1)
    ]
    if as_json:
        emit_json({"visits": rows})
        return
    for row, visit in zip(rows, visits, strict=True):
        place = " ".join(f"{name}={value:g}" for name, value in in_file_units(axes, visit.position).items())
        out.print(f"{row['visit']:>4} {row['test']:<12} {row['axis']:<2} {row['approach']:<10} {place}", soft_wrap=True)


def _print_record(record: GantryRecord, path: Path, *, as_json: bool) -> None:
    from uvgs_bench.cli.console import console, emit_json, out
    from uvgs_bench.store.gantry_records import record_tables

    if as_json:
        emit_json(record_tables(record) | {"file": str(path)})
    else:
        out.print(f"judged by    {record.judged_by}", markup=False, soft_wrap=True)
        out.print("axis".ljust(30) + "".join(axis.name.rjust(10) for axis in record.axes))
        for label, key, unit, decimals in _FIGURES:
            values = [getattr(axis, key) for axis in record.axes]
            if any(value is not None for value in values):
                cells = "".join(("-" if v is None else f"{v:.{decimals}f}").rjust(10) for v in values)
                out.print(f"{label:<30}{cells}  {unit}", soft_wrap=True)
        for pair in record.pairs:
            doubt = f"{pair.squareness_mrad:.3f} +- {pair.squareness_sigma_mrad:.3f} mrad (1 s)"
            out.print(f"{'squareness ' + '-'.join(pair.axes):<30}{doubt}", soft_wrap=True)
    for remark in record.remarks:
        console.print(f"remark: {remark}", markup=False, soft_wrap=True)
