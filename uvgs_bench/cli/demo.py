"""``uvgs demo``: the whole job once, on the simulated bench."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.one_core import compute_on_one_core
from uvgs_bench.cli.options import Force, Json, Quiet, Seed
from uvgs_bench.errors import ExitCode

if TYPE_CHECKING:
    from uvgs_bench.sessions.demo import DemoResult


def demo(
    out_folder: Annotated[Path, typer.Option("--out", help="Folder for calibration, run and report.")] = Path(
        "reports/demo"
    ),
    seed: Seed = 1,
    stations: Annotated[
        int | None, typer.Option(min=6, max=2000, help="Number of random stations.  [default: the shipped grid of 30]")
    ] = None,
    force: Force = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Calibrate, sweep, solve, register, judge and report on the simulated bench; no hardware needed."""
    compute_on_one_core()
    from uvgs_bench.cli.console import progress_sink
    from uvgs_bench.report import write_reports
    from uvgs_bench.sessions.demo import demonstrate
    from uvgs_bench.sessions.events import StageFinished, StageStarted

    with progress_sink(quiet=quiet) as sink:
        result = demonstrate(out_folder, seed=seed, station_count=stations, force=force, sink=sink)
        sink(StageStarted("report"))
        paths = write_reports(result.run, result.judgement, out_folder)
        sink(StageFinished("report", "html, pdf, json"))
    _print_result(result, paths, as_json)
    codes = {"pass": ExitCode.DONE, "fail": ExitCode.LIMITS_MISSED}
    raise typer.Exit(int(codes.get(result.judgement.verdict, ExitCode.INCONCLUSIVE)))


def _print_result(result: DemoResult, paths: dict[str, Path], as_json: bool) -> None:
    from dataclasses import asdict

    from uvgs_bench.cli.console import emit_json, out, print_path, verdict_markup
    from uvgs_bench.units import deg_from_rad, mm_from_m

    judgement, truth = result.judgement, result.truth
    if as_json:
        emit_json(
            {
                "verdict": judgement.verdict,
                "limits": [asdict(verdict) for verdict in judgement.verdicts],
                "truth": None if truth is None else asdict(truth),
                "run": str(result.run.path),
                "calibration": str(result.calibration_file),
                "report": {name: str(path) for name, path in paths.items()},
            }
        )
        return
    out.print(f"\nverdict      {verdict_markup(judgement.verdict)}")
    for verdict in judgement.verdicts:
        limit = verdict.limit
        sign = "<" if limit.bound == "max" else ">"
        out.print(
            f"  {limit.quantity:<22} {verdict.value:8.3f} {limit.unit:<3} "
            f"[{verdict.low:.3f}, {verdict.high:.3f}]  {sign} {limit.value:g}  {verdict_markup(verdict.verdict)}"
        )
    if truth is not None:
        out.print(
            f"truth        sensor against the simulated truth: position RMS {mm_from_m(truth.position_rms_m):.3f} mm, "
            f"attitude RMS {deg_from_rad(truth.attitude_rms_rad):.3f} deg, {truth.count} poses"
        )
    print_path("run", result.run.path)
    for name, path in paths.items():
        print_path(name, path)
