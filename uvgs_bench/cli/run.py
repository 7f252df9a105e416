"""``uvgs run``: solve every capture of a source, one line per capture."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.options import Force, Json, Quiet
from uvgs_bench.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from uvgs_bench.beacon import Beacon
    from uvgs_bench.camera.calibration import Calibration
    from uvgs_bench.sensor.capture import Capture
    from uvgs_bench.sensor.config import UvgsConfig
    from uvgs_bench.sessions.stream import Tally
    from uvgs_bench.store.run import Run


def run(
    source: Annotated[
        str, typer.Argument(help="images:DIR, video:FILE, uvc:0, sim:BENCH.toml?count=N, or a run folder.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Pose file: .csv (misses included), .tum or .jsonl.")],
    camera: Annotated[Path | None, typer.Option("--camera", help="Calibration; a run folder has its own.")] = None,
    beacon: Annotated[Path | None, typer.Option("--beacon", help="Beacon; a run folder has its own.")] = None,
    config: Annotated[Path | None, typer.Option("--config", help="Sensor parameters, TOML.")] = None,
    limit: Annotated[int | None, typer.Option("--limit", min=1, help="Stop after so many captures.")] = None,
    track: Annotated[
        bool,
        typer.Option("--track/--no-track", help="Look for the LEDs where the last pose puts them; else each alone."),
    ] = False,
    threads: Annotated[int, typer.Option("--threads", min=1, help="Threads of OpenCV; 1 is deterministic.")] = 1,
    debug_images: Annotated[
        Path | None, typer.Option("--debug-images", help="Folder for one picture per capture of what each stage saw.")
    ] = None,
    force: Force = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Solve every capture and write its pose, or why there is none."""
    from time import perf_counter

    from uvgs_bench.cli.console import progress_sink
    from uvgs_bench.interop.trajectories import open_pose_writer
    from uvgs_bench.sensor.uvgs import Uvgs
    from uvgs_bench.sessions.debug_images import DebugImages
    from uvgs_bench.sessions.events import Remark
    from uvgs_bench.sessions.stream import Tally, solve_source

    with ExitStack() as stack:
        recorded = _recorded_run(source)
        calibration, lights, parameters = _setup(recorded, camera, beacon, config)
        captures, total = _open(source, recorded, stack)
        writer = stack.enter_context(open_pose_writer(out, force=force))
        sink = stack.enter_context(progress_sink(quiet=quiet))
        uvgs = Uvgs(calibration, lights, parameters, clock=perf_counter)
        sink(Remark("info", "loading compiled kernels"))
        uvgs.warm_up()
        tally = Tally()
        drawn = None if debug_images is None else DebugImages(debug_images, uvgs, force=force)
        stream = solve_source(captures, uvgs, sink, total=total, limit=limit, track=track, threads=threads)
        for capture, outcome in stream:
            writer.write(capture, outcome)
            tally.add(outcome)
            if drawn is not None:
                drawn.write(capture, outcome)
    _show(tally, out, as_json)
    code = ExitCode.DONE if tally.ok else ExitCode.INCONCLUSIVE if tally.total else ExitCode.INPUT
    raise typer.Exit(int(code))


def _recorded_run(source: str) -> Run | None:
    from uvgs_bench.store.run import is_run, read_run

    folder = Path(source)
    if is_run(folder):
        return read_run(folder)
    if ":" not in source:
        found = "that folder is no run" if folder.is_dir() else "there is no such run folder"
        raise ConfigError(f"{found}; for pictures write images:{source}", source)
    return None


def _setup(
    recorded: Run | None, camera: Path | None, beacon: Path | None, config: Path | None
) -> tuple[Calibration, Beacon, UvgsConfig]:
    from uvgs_bench.sensor.config import UvgsConfig
    from uvgs_bench.store.beacons import read_beacon
    from uvgs_bench.store.calibrations import read_calibration
    from uvgs_bench.store.documents import read_document
    from uvgs_bench.store.run_writer import SETUP, SETUP_SENSOR

    if recorded is None and camera is None:
        raise ConfigError("is needed unless the source is a run folder", "--camera")
    if recorded is None and beacon is None:
        raise ConfigError("is needed unless the source is a run folder", "--beacon")
    calibration = read_calibration(camera) if camera is not None else None
    lights = read_beacon(beacon) if beacon is not None else None
    if recorded is not None:
        calibration, lights = calibration or recorded.calibration, lights or recorded.beacon
        own = recorded.path / SETUP / SETUP_SENSOR
        config = own if config is None and own.is_file() else config
    assert calibration is not None
    assert lights is not None
    return calibration, lights, UvgsConfig() if config is None else read_document(config, UvgsConfig)


def _open(source: str, recorded: Run | None, stack: ExitStack) -> tuple[Iterable[Capture], int | None]:
    if recorded is not None:
        from uvgs_bench.sessions.stream import read_run_captures, run_captures

        return read_run_captures(recorded), len(run_captures(recorded))
    from uvgs_bench.devices.cameras.registry import open_camera

    opened = stack.enter_context(open_camera(source))
    return opened, opened.length


def _show(tally: Tally, out_path: Path, as_json: bool) -> None:
    from rich.table import Table

    from uvgs_bench.cli.console import emit_json, out, print_path
    from uvgs_bench.units import ms_from_s

    times = tally.median_stage_s()
    if as_json:
        emit_json({
            "captures": tally.total,
            "poses": tally.ok,
            "misses": dict(tally.reasons.most_common()),
            "median_stage_s": times,
            "out": str(out_path),
        })  # fmt: skip
        return
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_row("captures", str(tally.total))
    table.add_row("[green]poses[/]", str(tally.ok))
    for reason, count in tally.reasons.most_common():
        table.add_row(f"[yellow]miss[/] {reason}", str(count))
    for stage, duration_s in times.items():
        table.add_row(f"[dim]median {stage}[/]", f"{ms_from_s(duration_s):.3f} ms")
    out.print(table)
    print_path("poses", out_path)
