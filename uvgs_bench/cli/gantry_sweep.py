"""``uvgs gantry-sweep``: carry the beacon through a procedure, capture and solve at every station, keep a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.one_core import compute_on_one_core
from uvgs_bench.cli.options import DEFAULT_BENCH, Json, Quiet

if TYPE_CHECKING:
    from uvgs_bench.sessions.planning import Plan
    from uvgs_bench.sessions.sweep import SweepResult


def gantry_sweep(
    procedure: Annotated[Path | None, typer.Argument(help="Procedure file; with --resume that of the run.")] = None,
    bench: Annotated[Path | None, typer.Option(help=f"Bench file; {DEFAULT_BENCH} when absent.")] = None,
    camera: Annotated[Path | None, typer.Option(help="Camera calibration in place of the bench's.")] = None,
    port: Annotated[str | None, typer.Option(help="Gantry in place of the bench's, like grbl:/dev/ttyACM0.")] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="Sensor parameters in place of the bench's, TOML.")
    ] = None,
    camera_source: Annotated[str | None, typer.Option(help="Camera in place of the bench's, like uvc:0.")] = None,
    out: Annotated[
        Path, typer.Option(help="Folder the run folder is made in; a resumed run stays where it is.")
    ] = Path("reports"),
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Check every point and path, move nothing.")] = False,
    resume_run: Annotated[Path | None, typer.Option("--resume", help="Run folder to take up again.")] = None,
    accept_changes: Annotated[
        bool,
        typer.Option("--accept-changes", help="With --resume: also when files or settings changed; the run says so."),
    ] = False,
    keep: Annotated[
        str, typer.Option(help="Pictures to keep: all, worst or none; a resumed run keeps what it kept.")
    ] = "all",
    seed: Annotated[int | None, typer.Option(min=0, help="Seed in place of the files'.")] = None,
    sim_speed: Annotated[float, typer.Option(min=0.1, help="Speed of the simulated bench against real time.")] = 50.0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Sweep the beacon through a procedure and keep everything as a run; a trajectory is driven after its places.

    Ctrl-C stops the motion first, closes the run properly and says how to resume it; once more while it stops is a hard
    stop that loses the position. Ctrl-Z pauses at the next station until fg.
    """
    compute_on_one_core()
    from uvgs_bench.cli.console import progress_sink
    from uvgs_bench.errors import ConfigError, UnreadableDocument
    from uvgs_bench.sessions.bench_setup import read_setup, read_setup_of, resume, sweep
    from uvgs_bench.sessions.planning import plan
    from uvgs_bench.sessions.procedure import read_procedure
    from uvgs_bench.store.bench import read_bench
    from uvgs_bench.store.run import read_run
    from uvgs_bench.store.run_writer import KEEPS

    if keep not in KEEPS:
        raise ConfigError(f"must be one of {', '.join(KEEPS)}, got '{keep}'", key="--keep")
    if resume_run is not None:
        if seed is not None:
            raise ConfigError("a resumed run keeps its seed", key="--seed")
        if config is not None:
            raise ConfigError("a resumed run keeps its sensor", key="--config")
        run = read_run(resume_run)
        again = read_setup_of(
            run, procedure=procedure, bench=bench, camera=camera, gantry_spec=port, camera_spec=camera_source
        )
        with progress_sink(quiet=quiet) as sink:
            result = resume(run, again, simulated_speed=sim_speed, sink=sink, accepts_changes=accept_changes)
        _print_result(result, as_json)
        return
    if accept_changes:
        raise ConfigError("is said of a run that is taken up again: add --resume", key="--accept-changes")
    if procedure is None:
        raise ConfigError("name a procedure file, for example procedures/demo_grid.toml", key="PROCEDURE")
    if bench is None and not DEFAULT_BENCH.exists():
        raise UnreadableDocument(
            "no bench file here: make a workspace with uvgs init, or name one with --bench", str(DEFAULT_BENCH)
        )
    bench = bench or DEFAULT_BENCH
    if dry_run:
        _print_plan(plan(read_procedure(procedure).seeded(seed), read_bench(bench).envelope), as_json)
        return
    set_up = read_setup(
        procedure, bench, camera=camera, gantry_spec=port, camera_spec=camera_source, seed=seed, sensor=config
    )
    with progress_sink(quiet=quiet) as sink:
        result = sweep(set_up, out, keep=keep, simulated_speed=sim_speed, sink=sink)
    _print_result(result, as_json)


def _print_plan(plan: Plan, as_json: bool) -> None:
    from uvgs_bench.cli.console import emit_json, out
    from uvgs_bench.units import mm_from_m

    facts: dict[str, object] = {
        "procedure": plan.procedure.name,
        "stations": len(plan.stations),
        "waypoints": plan.waypoint_count,
        "register_waypoints": plan.register_waypoint_count,
        "captures": plan.capture_count,
        **({} if plan.motion is None else {"motion_s": round(plan.motion.duration_s, 1)}),
        "distance_mm": round(mm_from_m(plan.distance_m), 3),
        "duration_s": round(plan.duration_s, 1),
        "checked": "every waypoint, approach and path lies inside the envelope",
    }
    if as_json:
        emit_json(facts)
        return
    for name, value in facts.items():
        out.print(f"{name:<20} {value}", soft_wrap=True)


def _print_result(result: SweepResult, as_json: bool) -> None:
    from uvgs_bench.cli.console import emit_json, out, print_path
    from uvgs_bench.errors import ExitCode

    if as_json:
        emit_json(
            {
                "run": str(result.path),
                "stations": result.station_count,
                "captures": result.capture_count,
                "poses": result.pose_count,
                "misses": result.misses,
                "duration_s": result.duration_s,
            }
        )
    else:
        out.print(f"stations     {result.station_count}")
        out.print(f"captures     {result.capture_count}, {result.pose_count} with a pose")
        for reason, count in sorted(result.misses.items(), key=lambda item: -item[1]):
            out.print(f"  missed     {count} {reason}")
        print_path("run", result.path)
        print_path("next", f"uvgs report {result.path}")
    if result.capture_count and not result.pose_count:
        raise typer.Exit(int(ExitCode.INCONCLUSIVE))
