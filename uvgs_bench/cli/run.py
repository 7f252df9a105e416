"""``uvgs run``: solve every capture of a source, one line per capture and beacon."""

from __future__ import annotations

import gc
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from uvgs_bench.cli.options import Force, Json, Quiet
from uvgs_bench.errors import ConfigError, ExitCode, RunError

if TYPE_CHECKING:
    from uvgs_bench.beacon import Beacon
    from uvgs_bench.camera.calibration import Calibration
    from uvgs_bench.devices.cameras.source import CameraSource
    from uvgs_bench.sensor.capture import Capture
    from uvgs_bench.sensor.config import UvgsConfig
    from uvgs_bench.sensor.handover import HandoverPolicy
    from uvgs_bench.sensor.uvgs import Uvgs
    from uvgs_bench.sessions.debug_images import DebugImages
    from uvgs_bench.sessions.exposure_loop import ExposureLoop
    from uvgs_bench.store.run import Run

_BEACONS = "Several beacons"
_LIGHT = "Light"
_OUTPUT = "Output"


def run(
    source: Annotated[
        str, typer.Argument(help="images:DIR, video:FILE, uvc:0, sim:BENCH.toml?count=N, or a run folder.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Pose file: .csv (misses included), .tum or .jsonl.")],
    camera: Annotated[Path | None, typer.Option("--camera", help="Calibration; a run folder has its own.")] = None,
    beacon: Annotated[
        list[Path] | None, typer.Option("--beacon", help="Beacon; may be repeated. A run folder has its own.")
    ] = None,
    config: Annotated[Path | None, typer.Option("--config", help="Sensor parameters, TOML.")] = None,
    limit: Annotated[int | None, typer.Option("--limit", min=1, help="Stop after so many captures.")] = None,
    track: Annotated[
        bool,
        typer.Option("--track/--no-track", help="Look for the LEDs where the last pose puts them; else each alone."),
    ] = False,
    threads: Annotated[
        int,
        typer.Option(
            "--threads",
            min=1,
            help="Threads of OpenCV; the sensor's own code uses one. With 1 no thread waits for another.",
        ),
    ] = 1,
    handover: Annotated[
        Literal["quality", "position", "command"],
        typer.Option(
            "--handover",
            help="Which beacon is active: the least deviation, the nearest or by --zone-m, or the one named last on "
            "standard input (one line is read per capture).",
            rich_help_panel=_BEACONS,
        ),
    ] = "quality",
    active: Annotated[
        str | None,
        typer.Option("--active", help="Name of the beacon that is active at first.", rich_help_panel=_BEACONS),
    ] = None,
    zone_m: Annotated[
        list[str] | None,
        typer.Option(
            "--zone-m", help="NAME=NEAR:FAR, ranges for --handover position; repeat.", rich_help_panel=_BEACONS
        ),
    ] = None,
    hold_s: Annotated[
        float | None,
        typer.Option(
            "--hold-s",
            min=0.0,
            help="Repeat the active beacon's last pose so long, marked as held; 0.5 with several beacons, else 0.",
            rich_help_panel=_BEACONS,
        ),
    ] = None,
    difference: Annotated[
        bool,
        typer.Option(
            "--difference",
            help="Take each unlit capture from its lit neighbour: for retroreflectors beside a switched lamp.",
            rich_help_panel=_LIGHT,
        ),
    ] = False,
    auto_exposure: Annotated[
        bool,
        typer.Option(
            "--auto-exposure",
            help="Keep LED peaks between 60 and 90 % of full scale (uvc: and sim:).",
            rich_help_panel=_LIGHT,
        ),
    ] = False,
    max_exposure_ms: Annotated[
        float,
        typer.Option("--max-exposure-ms", min=0.0, help="Bound of --auto-exposure.", rich_help_panel=_LIGHT),
    ] = 20.0,
    timing: Annotated[
        bool, typer.Option("--timing", help="Show how long each stage took, as histograms.", rich_help_panel=_OUTPUT)
    ] = False,
    debug_images: Annotated[
        Path | None,
        typer.Option(
            "--debug-images",
            help="Folder for one picture per capture of what each stage saw.",
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
    force: Force = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Solve every capture and write its pose, or why there is none. Ctrl-C keeps what was written."""
    from time import perf_counter

    from uvgs_bench.cli.console import progress_sink
    from uvgs_bench.cli.run_commands import standard_input_names
    from uvgs_bench.cli.run_summary import show_summary
    from uvgs_bench.interop.trajectories import open_pose_writer
    from uvgs_bench.sensor.difference import DifferenceConfig
    from uvgs_bench.sensor.uvgs import Uvgs
    from uvgs_bench.sessions.events import Remark
    from uvgs_bench.sessions.interruption import interruptible
    from uvgs_bench.sessions.stream import StreamRules, solve_source
    from uvgs_bench.sessions.tally import Tally

    is_interrupted = False
    with ExitStack() as stack:
        recorded = _recorded_run(source)
        calibration, beacons, parameters = _setup(recorded, camera, beacon or [], config)
        names = tuple(lights.name for lights in beacons)
        policy = _policy(handover, zone_m or [], hold_s, names, active)
        captures, opened, total = _open(source, recorded, stack)
        sensors = {lights.name: Uvgs(calibration, lights, parameters, clock=perf_counter) for lights in beacons}
        loop = _exposure_loop(opened, source, sensors, max_exposure_ms) if auto_exposure else None
        writer = stack.enter_context(open_pose_writer(out, force=force, beacons=names))
        sink = stack.enter_context(progress_sink(quiet=quiet))
        stack.enter_context(interruptible())
        sink(Remark("info", "loading compiled kernels"))
        tally = Tally(names)
        drawn = _debug_folders(debug_images, sensors, force)
        rules = StreamRules(limit, track, threads, policy, active, DifferenceConfig() if difference else None)
        command = standard_input_names() if handover == "command" and len(names) > 1 else None
        try:
            for uvgs in sensors.values():
                uvgs.warm_up()
            # What is loaded now stays: a collection that walks through it takes 25 ms out of some capture.
            gc.freeze()
            stream = solve_source(captures, sensors, sink, rules, total=total, exposure=loop, command=command)
            for answered in stream:
                for name, (outcome, note) in answered.lines.items():
                    writer.write(answered.capture, outcome, note)
                    tally.add(name, outcome, note.flags, is_active=note.is_active)
                tally.captures += 1
                tally.exposure_changes += any(note.next_exposure_s for _, note in answered.lines.values())
                for name, folder in drawn.items():
                    folder.write(answered.capture, answered.outcomes[name])
        except KeyboardInterrupt:
            is_interrupted = True
    show_summary(tally, writer.paths, timing=timing, as_json=as_json, is_interrupted=is_interrupted)
    if is_interrupted:
        raise typer.Exit(int(ExitCode.INTERRUPTED))
    code = ExitCode.DONE if tally.poses else ExitCode.INCONCLUSIVE if tally.captures else ExitCode.INPUT
    raise typer.Exit(int(code))


def _recorded_run(source: str) -> Run | None:
    from uvgs_bench.store.run import is_run, read_run

    folder = Path(source)
    if is_run(folder):
        return read_run(folder)
    if ":" not in source:
        if folder.is_dir():
            raise ConfigError(f"that folder is no run; for pictures write images:{source}", source)
        raise RunError(f"there is no such run folder; for pictures write images:{source}", source)
    return None


def _setup(
    recorded: Run | None, camera: Path | None, beacon: list[Path], config: Path | None
) -> tuple[Calibration, list[Beacon], UvgsConfig]:
    from uvgs_bench.sensor.config import UvgsConfig
    from uvgs_bench.store.beacons import read_beacon
    from uvgs_bench.store.calibrations import read_calibration
    from uvgs_bench.store.documents import read_document
    from uvgs_bench.store.run_writer import SETUP, SETUP_SENSOR

    if recorded is None and camera is None:
        raise ConfigError("is needed unless the source is a run folder", "--camera")
    if recorded is None and not beacon:
        raise ConfigError("is needed unless the source is a run folder", "--beacon")
    calibration = read_calibration(camera) if camera is not None else None
    beacons = [read_beacon(path) for path in beacon]
    if recorded is not None:
        calibration, beacons = calibration or recorded.calibration, beacons or [recorded.beacon]
        own = recorded.path / SETUP / SETUP_SENSOR
        config = own if config is None and own.is_file() else config
    assert calibration is not None
    names = [lights.name for lights in beacons]
    for path, lights in zip(beacon, beacons, strict=False):
        if names.count(lights.name) > 1:
            raise ConfigError(f"several beacons are named '{lights.name}'; each needs a name of its own", str(path))
    parameters = UvgsConfig() if config is None else read_document(config, UvgsConfig)
    if len(beacons) > 1 and parameters.hue_deg is not None:
        raise ConfigError(
            "one hue cannot hold for several beacons; it belongs into their files", str(config), "hue_deg"
        )
    return calibration, beacons, parameters


def _policy(
    mode: Literal["quality", "position", "command"],
    zones: list[str],
    hold_s: float | None,
    names: tuple[str, ...],
    active: str | None,
) -> HandoverPolicy:
    from uvgs_bench.sensor.handover import HandoverPolicy

    known = ", ".join(names)
    if active is not None and active not in names:
        raise ConfigError(f"unknown beacon '{active}', expected one of: {known}", "--active")
    if zones and mode != "position":
        raise ConfigError("needs --handover position", "--zone-m")
    zones_m: dict[str, tuple[float, float]] = {}
    for text in zones:
        name, _, span = text.rpartition("=")
        near, _, far = span.partition(":")
        if name not in names:
            raise ConfigError(f"expected NAME=NEAR:FAR with a beacon of {known}, got '{text}'", "--zone-m")
        try:
            zones_m[name] = float(near), float(far)
        except ValueError:
            raise ConfigError(f"expected NAME=NEAR:FAR in m, got '{text}'", "--zone-m") from None
    if hold_s is None:
        hold_s = 0.5 if len(names) > 1 else 0.0
    try:
        # One beacon is always the active one.
        return HandoverPolicy(mode if len(names) > 1 else "quality", zones_m, hold_s=hold_s)
    except ValueError as error:
        raise ConfigError(str(error), "--zone-m") from None


def _open(
    source: str, recorded: Run | None, stack: ExitStack
) -> tuple[Iterable[Capture], CameraSource | None, int | None]:
    if recorded is not None:
        from uvgs_bench.sessions.stream import read_run_captures, run_captures

        return read_run_captures(recorded), None, len(run_captures(recorded))
    from uvgs_bench.devices.cameras.registry import open_camera

    opened = stack.enter_context(open_camera(source))
    return opened, opened, opened.length


def _exposure_loop(
    opened: CameraSource | None, source: str, sensors: dict[str, Uvgs], longest_ms: float
) -> ExposureLoop:
    from uvgs_bench.devices.cameras.source import ExposureControl
    from uvgs_bench.sensor.exposure import ExposurePolicy
    from uvgs_bench.sessions.exposure_loop import ExposureLoop
    from uvgs_bench.units import s_from_ms

    control: object = opened
    if not isinstance(control, ExposureControl):
        raise ConfigError("the exposure of this source cannot be set; leave --auto-exposure out", source)
    try:
        policy = ExposurePolicy(longest_s=s_from_ms(longest_ms))
    except ValueError as error:
        raise ConfigError(str(error), "--max-exposure-ms") from None
    return ExposureLoop(control, sensors, policy)


def _debug_folders(folder: Path | None, sensors: dict[str, Uvgs], force: bool) -> dict[str, DebugImages]:
    """One folder, or one per beacon."""
    if folder is None:
        return {}
    from uvgs_bench.sessions.debug_images import DebugImages

    several = len(sensors) > 1
    return {
        name: DebugImages(folder / name if several else folder, uvgs, force=force) for name, uvgs in sensors.items()
    }
