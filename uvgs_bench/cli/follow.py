"""``uvgs follow``: a follower keeps its station before a leader by the sensor's poses alone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.one_core import compute_on_one_core
from uvgs_bench.cli.options import DEFAULT_BENCH, BenchFile, Json, Quiet, Seed
from uvgs_bench.errors import ExitCode

if TYPE_CHECKING:
    from uvgs_bench.sessions.follow import FollowResult


def follow(
    scenario: Annotated[
        str,
        typer.Argument(
            metavar="[SCENARIO]",
            help="square, slow_square, granite_square, line, hold, multi, or a scenario or procedure file.",
        ),
    ] = "square",
    plant: Annotated[
        str, typer.Option("--plant", help="What follows: flyer, gantry, udp:HOST:PORT, ros1:POSE_TOPIC or ros2:...")
    ] = "flyer",
    inject: Annotated[
        str, typer.Option("--inject", help="Faults, like loss=2s@10s,latency=80ms,drop=0.05,cpu=0.5.")
    ] = "",
    realtime: Annotated[
        bool, typer.Option("--realtime", help="Keep pace with the wall clock; otherwise time is simulated.")
    ] = False,
    bench: BenchFile = DEFAULT_BENCH,
    config: Annotated[
        Path | None, typer.Option("--config", help="Sensor parameters in place of the bench's, TOML.")
    ] = None,
    seed: Seed = 0,
    out: Annotated[Path, typer.Option("--out", help="Folder the session's own folder is made in.")] = Path("reports"),
    no_report: Annotated[bool, typer.Option("--no-report", help="Keep the record, make no report.")] = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Follow a leader: poses are filtered, a law makes commands, a free-flyer or the gantry moves.

    Ends with 1 when the station is lost or the steady error exceeds the tolerance, 3 when it cannot be told.
    """
    compute_on_one_core()
    from uvgs_bench.cli.console import emit_json, progress_sink
    from uvgs_bench.errors import ConfigError
    from uvgs_bench.sessions.follow import follow as lead
    from uvgs_bench.sessions.follow_procedure import leader_of
    from uvgs_bench.sessions.follow_scenario import parse_faults
    from uvgs_bench.sessions.follow_setup import read_follow_setup

    faults = parse_faults(inject)
    set_up = read_follow_setup(leader_of(scenario, bench), bench, faults, seed, config)
    with progress_sink(quiet=quiet) as sink:
        if plant == "gantry":
            if realtime:
                raise ConfigError("the gantry keeps its own time", key="--realtime")
            from uvgs_bench.sessions.follow_gantry import follow_with_gantry

            result = follow_with_gantry(set_up, out, sink=sink)
        else:
            result = lead(set_up, out, plant=plant, realtime=realtime, sink=sink)
    reports = {} if no_report else _report(result)
    if as_json:
        emit_json(_facts(result, reports))
    else:
        _print(result, reports)
    codes = {"fail": ExitCode.LIMITS_MISSED, "inconclusive": ExitCode.INCONCLUSIVE}
    if result.verdict in codes:
        raise typer.Exit(int(codes[result.verdict]))


def _report(result: FollowResult) -> dict[str, str]:
    from uvgs_bench.report import write_document
    from uvgs_bench.report.follow_page import build_follow_document

    written = write_document(build_follow_document(result.run), result.run.path)
    return {name: str(path) for name, path in written.items()}


def _facts(result: FollowResult, reports: dict[str, str]) -> dict[str, object]:
    from dataclasses import asdict

    run = result.run
    return {
        "scenario": run.manifest.name,
        "plant": run.manifest.plant,
        "seed": run.manifest.seed,
        "faults": run.manifest.facts.get("faults", ""),
        "verdict": result.verdict,
        "headline": result.headline,
        "ending": run.ending,
        "reason": run.reason,
        "quality": asdict(result.quality),
        "margins": run.manifest.facts.get("margins"),
        "simulated_largest_latency_s": run.manifest.facts.get("simulated_largest_latency_s"),
        "run": str(run.path),
        "reports": reports,
    }


def _print(result: FollowResult, reports: dict[str, str]) -> None:
    from rich.markup import escape
    from rich.table import Table

    from uvgs_bench.cli.console import out, print_path, verdict_markup
    from uvgs_bench.units import deg_from_rad, mm_from_m, percent_from_fraction

    run, q = result.run, result.quality
    rows: list[tuple[str, float | None, str, int]] = [
        ("steady error, worst", mm_from_m(q.steady_worst_m), "mm", 1),
        ("  on the way", mm_from_m(q.cruise_worst_m), "mm", 1),
        ("tracking error, RMS", mm_from_m(q.rms_m), "mm", 1),
        ("tracking error, worst", mm_from_m(q.worst_m), "mm", 1),
        ("attitude error, worst", deg_from_rad(q.worst_rad), "deg", 2),
        ("overshoot", None if q.overshoot_m is None else mm_from_m(q.overshoot_m), "mm", 1),
        ("in tolerance", percent_from_fraction(q.in_tolerance), "%", 1),
        ("captures with a pose", percent_from_fraction(q.pose_share), "%", 1),
    ]
    table = Table(
        title=escape(f"{run.manifest.name}, {run.manifest.plant}"), title_justify="left", box=None, pad_edge=False
    )
    table.add_column("what", overflow="fold")
    table.add_column("", justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    for name, value, unit, decimals in rows:
        is_known = value is not None and value == value
        table.add_row(name, f"{value:.{decimals}f}" if is_known else "-", unit if is_known else "")
    out.print(table)
    for loss in q.losses:
        back = "never recovered" if loss.recovery_s is None else f"back in tolerance {loss.recovery_s:.1f} s later"
        worst = f"worst {mm_from_m(loss.worst_m):.0f} mm"
        said = f"loss at {loss.begin_s:.1f} s for {loss.duration_s:.1f} s: {', '.join(loss.modes)}; {worst}; {back}"
        out.print(escape(said))
    out.print(f"verdict      {verdict_markup(result.verdict)} {escape(result.headline)}")
    print_path("session", run.path)
    if "html" in reports:
        print_path("report", reports["html"])
