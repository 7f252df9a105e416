"""``uvgs benchmark detection``: uVGS against square tags of the same span, in the same simulated captures."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.options import Json, Quiet, Seed
from uvgs_bench.errors import ExitCode

if TYPE_CHECKING:
    from uvgs_bench.sessions.detection_benchmark import DetectionBenchmark
    from uvgs_bench.sessions.detection_scores import Row

_TABLE_WIDTH = 104


class TagSpan(StrEnum):
    """What of the tag equals the beacon's largest LED distance."""

    DIAGONAL = "diagonal"
    SIDE = "side"


def detection(
    captures: Annotated[
        int | None, typer.Option(min=1, max=10_000, help="Captures per condition.  [default: 20; 4 with --quick]")
    ] = None,
    span: Annotated[
        TagSpan, typer.Option(help="What of the tag equals the beacon's largest LED distance.")
    ] = TagSpan.DIAGONAL,
    quick: Annotated[bool, typer.Option("--quick", help="One condition of each kind only.")] = False,
    seed: Seed = 1,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """uVGS, ArUco and AprilTag on the same simulated pictures: availability, pose error, time."""
    from uvgs_bench.cli.console import emit_json, progress_sink
    from uvgs_bench.sessions.detection_benchmark import as_tables, run_detection_benchmark
    from uvgs_bench.sessions.detection_conditions import default_conditions
    from uvgs_bench.store.beacons import read_beacon
    from uvgs_bench.store.workspace import examples_folder

    beacon = read_beacon(examples_folder() / "calib" / "beacons" / "tetra_small.toml")
    with progress_sink(quiet=quiet) as sink:
        result = run_detection_benchmark(
            beacon,
            conditions=default_conditions(quick=quick),
            capture_count=captures if captures is not None else 4 if quick else 20,
            seed=seed,
            span=span.value,
            sink=sink,
        )
    if as_json:
        emit_json(as_tables(result))
    else:
        _print_result(result)
    raise typer.Exit(int(ExitCode.DONE))


def _print_result(result: DetectionBenchmark) -> None:
    from rich.table import Table

    from uvgs_bench.cli.console import out

    for line in result.protocol:
        out.print(f"- {line}", markup=False)
    # A pipe has no width, and a cropped figure is worse than a long line.
    table = Table(box=None, pad_edge=False, header_style="bold", width=_TABLE_WIDTH)
    table.add_column("method", no_wrap=True)
    for title in ("poses", "false", "mm RMS", "deg RMS", "ms", "x mm", "x deg", "x ms"):
        table.add_column(title, justify="right", no_wrap=True)
    blocks = [(f"{condition.group} {condition.label}", rows) for condition, rows in result.conditions]
    for label, rows in [*blocks, ("all conditions", result.overall)]:
        table.add_row(f"[bold]{label}")
        for row in rows:
            table.add_row(f"  {row.method}", *_cells(row))
        for name in result.not_installed:
            table.add_row(f"  {name}", "not installed")
    out.print("ms: processor time per picture; x: times that of uVGS on the same pictures", markup=False)
    out.print(table, crop=False, no_wrap=True, overflow="ignore")
    for row in result.overall:
        if row.reasons:
            counts = ", ".join(f"{reason} {count}" for reason, count in row.reasons.items())
            out.print(f"no pose, {row.method}: {counts}", markup=False)


def _cells(row: Row) -> tuple[str, ...]:
    from uvgs_bench.units import deg_from_rad, mm_from_m, ms_from_s

    def number(value: float, digits: int) -> str:
        return f"{value:.{digits}f}" if value == value else "-"

    return (
        f"{row.pose_count}/{row.capture_count}",
        str(row.false_count),
        number(mm_from_m(row.position_rms_m), 3),
        number(deg_from_rad(row.attitude_rms_rad), 3),
        number(ms_from_s(row.time_s), 2),
        number(row.position_ratio, 1),
        number(row.attitude_ratio, 1),
        number(row.time_ratio, 1),
    )
