"""``uvgs run``: solve every capture of a source, one line per capture and beacon."""

from __future__ import annotations

import gc
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Literal

import typer

from uvgs_bench.cli.options import Force, Json, Quiet, given_options
from uvgs_bench.cli.view_options import (
    AllowMotion,
    Foxglove,
    FoxglovePort,
    SnapshotFolder,
    View,
    ViewOptions,
    ViewPort,
)
from uvgs_bench.errors import ConfigError, ExitCode

_BEACONS = "Several beacons"
_LIGHT = "Light"
_OUTPUT = "Output"
_MANY = "Many sources"


def run(
    context: typer.Context,
    source: Annotated[
        str | None,
        typer.Argument(
            help="images:DIR, video:FILE, bag:FILE, uvc:0, rtsp://..., sim:BENCH.toml?count=N, a run folder, or a file "
            "of --record."
        ),
    ] = None,
    out: Annotated[
        list[Path] | None,
        typer.Option(
            "--out",
            help="Poses: .csv and .jsonl (misses included), .tum, .bag (ROS 1), .mcap (ROS 2). May be repeated.",
        ),
    ] = None,
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
    reconnect_s: Annotated[
        float,
        typer.Option(
            "--reconnect-s",
            min=0.0,
            help="How long to wait for a live camera that was lost; 0 ends at the first loss.",
        ),
    ] = 60.0,
    record: Annotated[
        Path | None,
        typer.Option(
            "--record",
            help="Keep everything in one .mcap, pictures too; uvgs run FILE.mcap solves it again.",
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
    compression: Annotated[
        Literal["none", "bz2", "zstd"] | None,
        typer.Option("--compression", help="bz2 of .bag, zstd of .mcap; records have zstd.", rich_help_panel=_OUTPUT),
    ] = None,
    images: Annotated[bool, typer.Option("--images", help="Bags get the pictures.", rich_help_panel=_OUTPUT)] = False,
    annotated: Annotated[
        bool,
        typer.Option(
            "--annotated", help="Bags get pictures of what the sensor saw; some 20 ms each.", rich_help_panel=_OUTPUT
        ),
    ] = False,
    astrobee: Annotated[
        Literal["v1", "v2"] | None,
        typer.Option(
            "--astrobee",
            help="Bags get ff_msgs/VisualLandmarks: v1, or v2 with the field runtime.",
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
    udp: Annotated[
        str | None,
        typer.Option(
            "--udp", metavar="HOST:PORT", help="One JSON datagram per capture, misses too.", rich_help_panel=_OUTPUT
        ),
    ] = None,
    rate_hz: Annotated[
        float | None,
        typer.Option(
            "--rate-hz",
            min=0.001,
            help="Most answers a second for --udp, --view and --foxglove; files get all of them.",
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
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
    batch: Annotated[
        Path | None,
        typer.Option(
            "--batch",
            metavar="LIST",
            help="Solve every source of a text file, one a line, * allowed; --out names a folder, or a path with {} "
            "for the source's name. What is done is not done again.",
            rich_help_panel=_MANY,
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers", min=1, help="Processes of --batch; one per processor when left out.", rich_help_panel=_MANY
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler", help="Dask scheduler in place of processes, like tcp://host:8786.", rich_help_panel=_MANY
        ),
    ] = None,
    view: View = False,
    view_port: ViewPort = None,
    foxglove: Foxglove = False,
    foxglove_port: FoxglovePort = None,
    snapshots: SnapshotFolder = None,
    allow_motion: AllowMotion = None,
    force: Force = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Solve every capture and write its pose, or why there is none. Ctrl-C keeps what was written.

    Ends with 3 when there was no pose at all, 4 when an output is not whole.
    """
    from time import perf_counter

    from uvgs_bench.cli import live_view, run_record
    from uvgs_bench.cli.run_commands import standard_input_names
    from uvgs_bench.cli.run_outlets import OutletOptions, open_outlets
    from uvgs_bench.cli.run_setup import (
        exposure_loop,
        handover_policy,
        lens_of,
        open_captures,
        read_setup,
        recorded_run,
    )
    from uvgs_bench.cli.run_summary import show_summary
    from uvgs_bench.sensor.difference import DifferenceConfig
    from uvgs_bench.sensor.uvgs import Uvgs
    from uvgs_bench.sessions.events import Remark
    from uvgs_bench.sessions.interruption import interruptible
    from uvgs_bench.sessions.outlets import StreamSetup
    from uvgs_bench.sessions.stream import StreamRules, solve_source
    from uvgs_bench.sessions.tally import Tally
    from uvgs_bench.view.live_state import LiveState

    if batch is not None:
        from uvgs_bench.cli.batch import run_list

        run_list(context, batch, workers=workers, scheduler=scheduler, force=force, as_json=as_json, quiet=quiet)
    for option, value in (("--workers", workers), ("--scheduler", scheduler)):
        if value is not None:
            raise ConfigError("is for --batch", option)
    if source is None:
        raise ConfigError("is needed, or a list of them with --batch", "SOURCE")
    options = OutletOptions(
        tuple(out or ()), compression, images, annotated, astrobee, udp, rate_hz, debug_images, force
    )
    looks = ViewOptions(view, view_port, foxglove, foxglove_port, snapshots, allow_motion, rate_hz)
    options.check(source, record, looks.is_served)
    state = LiveState()
    is_interrupted = False
    with ExitStack() as stack:
        sink = stack.enter_context(live_view.panel_sink(state, quiet=quiet))
        source, gantry = live_view.own_twin(source, looks, stack)
        again = run_record.recording_of(source, stack, sink)
        recorded = recorded_run(source) if again is None else None
        own = None if again is None else again.setup
        known, beacons, parameters = read_setup(recorded, camera, beacon or [], config, own)
        if again is None:
            opened = open_captures(source, recorded, stack, sink, reconnect_s)
        else:
            opened = run_record.replayed(again, sink)
        calibration = lens_of(opened) if known is None else known
        names = tuple(lights.name for lights in beacons)
        policy = handover_policy(handover, zone_m or [], hold_s, names, active)
        rules = StreamRules(limit, track, threads, policy, active, DifferenceConfig() if difference else None)
        if again is not None:
            rules = run_record.replayed_rules(rules, again, given_options(context))
        recorder = None
        if record is not None:
            recorder, opened = run_record.open_recorder(record, opened, compression, stack, force=force)
        sensors = {lights.name: Uvgs(calibration, lights, parameters, clock=perf_counter) for lights in beacons}
        loop = None if again is None else run_record.replayed_exposure(again, opened.exposure, sensors)
        if auto_exposure and loop is None:
            loop = exposure_loop(opened.exposure, source, sensors, max_exposure_ms)
        setup = StreamSetup(source, calibration, tuple(beacons), parameters, sensors)
        shown = live_view.LiveOutlet(state, opened)
        more = () if recorder is None else (recorder,)
        outlets = open_outlets(stack, setup, options, sink, more, (shown,) if looks.is_served else ())
        controls = live_view.open_controls(
            sensors, parameters, opened, config, sink, perf_counter,
            has_record=record is not None or again is not None, has_exposure_loop=loop is not None,
        )  # fmt: skip
        if recorder is not None:
            run_record.begin_record(recorder, setup, rules, opened, loop)
        stack.enter_context(interruptible())
        live_view.serve(stack, looks, state, sensors, controls, gantry, sink)
        sink(Remark("info", "loading compiled kernels"))
        tally = Tally(names)
        command = None
        if rules.handover.mode == "command":
            command = standard_input_names() if again is None else again.command
            command = run_record.kept_command(recorder, command)
        try:
            for uvgs in sensors.values():
                uvgs.warm_up()
            # What is loaded now stays: a collection that walks through it takes 25 ms out of some capture.
            gc.freeze()
            stream = solve_source(
                opened.captures,
                sensors,
                sink,
                rules,
                total=opened.total,
                exposure=loop,
                command=command,
                flags_of=live_view.all_flags(opened.flags_of, controls.flags_of),
                is_live=opened.is_live,
            )
            for answered in stream:
                tally.take(answered.lines, None if opened.live is None else opened.live.age_s(answered.capture))
                outlets.put(answered)
                if not looks.is_served:
                    shown.put(answered)
                controls.apply()
        except KeyboardInterrupt:
            is_interrupted = True
    if opened.live is not None:
        tally.dropped, tally.gaps_s = opened.live.dropped, tuple(opened.live.gaps_s)
    show_summary(
        tally,
        outlets.paths,
        timing=timing or opened.live is not None,
        as_json=as_json,
        is_interrupted=is_interrupted,
        failures=outlets.failures,
    )
    if is_interrupted:
        raise typer.Exit(int(ExitCode.INTERRUPTED))
    if outlets.failures:
        raise typer.Exit(int(ExitCode.INPUT))
    code = ExitCode.DONE if tally.poses else ExitCode.INCONCLUSIVE if tally.captures else ExitCode.INPUT
    raise typer.Exit(int(code))
