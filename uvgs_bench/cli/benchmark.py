"""``uvgs benchmark``: how fast the sensor is, in figures of one run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from uvgs_bench.cli.benchmark_calibration import calibration
from uvgs_bench.cli.benchmark_centroids import centroids
from uvgs_bench.cli.benchmark_detection import detection
from uvgs_bench.cli.benchmark_labels import labels
from uvgs_bench.cli.benchmark_solvers import solvers
from uvgs_bench.cli.options import DEFAULT_BENCH, BenchFile, Json, Quiet, Seed

app = typer.Typer(help="Measure the sensor next to its peers: speed, solvers, detection.", no_args_is_help=True)
app.command("solvers")(solvers)
app.command("labels")(labels)
app.command("detection")(detection)
app.command("centroids")(centroids)
app.command("calibration")(calibration)


@app.callback()
def root() -> None:
    """Measure the sensor."""


@app.command("pipeline")
def pipeline(
    bench: BenchFile = DEFAULT_BENCH,
    config: Annotated[Path | None, typer.Option("--config", help="Sensor parameters, TOML.")] = None,
    captures: Annotated[int, typer.Option("--captures", min=1, help="Number of rendered captures.")] = 60,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Time each stage on rendered captures, one thread, next to cv2.aruco on pictures of the same size."""
    from rich.table import Table

    from uvgs_bench.cli.console import emit_json, out, progress_sink
    from uvgs_bench.sensor.config import UvgsConfig
    from uvgs_bench.sessions.benchmark import benchmark_pipeline
    from uvgs_bench.store.documents import read_document
    from uvgs_bench.units import ms_from_s

    parameters = UvgsConfig() if config is None else read_document(config, UvgsConfig)
    with progress_sink(quiet=quiet) as sink:
        result = benchmark_pipeline(bench, parameters, sink, count=captures, seed=seed)
    rows = (*result.stages, result.total, result.tracked, result.peer)
    if as_json:
        emit_json({
            "picture_px": [result.width_px, result.height_px],
            "captures": result.captures,
            "poses": result.poses,
            "seed": seed,
            "stages": {row.name: {"p10_s": row.p10_s, "median_s": row.median_s, "p99_s": row.p99_s} for row in rows},
            "tracked_poses": result.tracked_poses,
            "peer_found": result.peer_found,
            "peer_over_uvgs": result.ratio,
        })  # fmt: skip
        return
    table = Table(
        title=f"{result.width_px}x{result.height_px}, {result.poses} poses of {result.captures} captures, one thread",
        box=None,
        pad_edge=False,
    )
    table.add_column("stage")
    table.add_column("p10 ms", justify="right")
    table.add_column("median ms", justify="right")
    table.add_column("p99 ms", justify="right")
    for row in rows:
        table.add_row(
            row.name, f"{ms_from_s(row.p10_s):.3f}", f"{ms_from_s(row.median_s):.3f}", f"{ms_from_s(row.p99_s):.3f}"
        )
    out.print(table)
    out.print(f"cv2.aruco (its marker found in {result.peer_found}) takes {result.ratio:.1f} times as long")
