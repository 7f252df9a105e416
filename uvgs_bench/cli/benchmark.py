"""``uvgs benchmark``: how fast the sensor is, in figures of one run."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from uvgs_bench.cli.benchmark_calibration import calibration
from uvgs_bench.cli.benchmark_centroids import centroids
from uvgs_bench.cli.benchmark_detection import detection
from uvgs_bench.cli.benchmark_labels import labels
from uvgs_bench.cli.benchmark_live import live
from uvgs_bench.cli.benchmark_missions import missions
from uvgs_bench.cli.benchmark_solvers import solvers
from uvgs_bench.cli.options import DEFAULT_BENCH, BenchFile, Json, Quiet, Seed

app = typer.Typer(help="Measure the sensor next to its peers: speed, solvers, detection.", no_args_is_help=True)
app.command("solvers")(solvers)
app.command("labels")(labels)
app.command("detection")(detection)
app.command("centroids")(centroids)
app.command("calibration")(calibration)
app.command("missions")(missions)
app.command("live")(live)


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
    processes = {"first_pose": result.first_pose, "run": result.run}
    if as_json:
        rows = [row for row in (*result.stages, *result.wholes, result.peer) if row.median_s > 0.0]
        emit_json({
            "picture_px": [result.width_px, result.height_px],
            "captures": result.captures,
            "poses": result.poses,
            "seed": seed,
            "stages": {row.name: {"p10_s": row.p10_s, "median_s": row.median_s, "p99_s": row.p99_s} for row in rows},
            "tracked_poses": result.tracked_poses,
            "crowded_poses": result.crowded_poses,
            "peer_found": result.peer_found,
            "peer_over_uvgs": {row.name: result.ratio(row) for row in result.wholes if row in rows},
            "processes": {name: None if cost is None else asdict(cost) for name, cost in processes.items()},
        })  # fmt: skip
        return
    table = Table(
        title=f"{result.width_px}x{result.height_px}, {result.poses} poses of {result.captures} captures, one thread",
        box=None,
        pad_edge=False,
    )
    table.add_column("stage")
    for name in ("p10 ms", "median ms", "p99 ms", f"{result.peer.name} /"):
        table.add_column(name, justify="right")
    for row in (*result.stages, *result.wholes, result.peer):
        ratio = f"{result.ratio(row):.1f}" if row in result.wholes else ""
        times = (f"{ms_from_s(value):.3f}" for value in (row.p10_s, row.median_s, row.p99_s))
        table.add_row(row.name, *times, ratio)
    out.print(table)
    out.print(
        f"{result.tracked_poses} captures were tracked, {result.crowded_poses} solved among other lights; "
        f"{result.peer.name} found its marker in {result.peer_found}"
    )
    for name, cost in (("first pose", result.first_pose), ("a run", result.run)):
        if cost is None:
            out.print(f"{name}: failed")
        else:
            out.print(
                f"{name}, in a process of its own: {cost.wall_s:.2f} s, {cost.cpu_s:.2f} s on the processor; "
                + (f"{cost.peak_bytes / 1e6:.0f} MB resident at most" if cost.peak_bytes else "memory not known")
            )
