"""``uvgs benchmark solvers``: Table 1 of the paper, reproducible: every solver on the same drawn poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.options import Json, Quiet, Seed

if TYPE_CHECKING:
    from uvgs_bench.accuracy.solver_benchmark import BoundStudy, SolverRow, SpeedStudy, Spread

# Timing each door and peer on more poses than this says nothing new.
_TIMED = 2000


def solvers(
    poses: Annotated[int, typer.Option("--poses", min=100, help="Poses drawn; each solver gets all of them.")] = 5000,
    protocol: Annotated[str, typer.Option("--protocol", help="ours, or paper: matched as well as it allows.")] = "ours",
    beacon: Annotated[Path | None, typer.Option("--beacon", help="Beacon file; the shipped one by default.")] = None,
    sigma_px: Annotated[
        float | None, typer.Option("--sigma-px", min=1e-6, help="Centroid noise instead of the protocol's, px.")
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compare pose solvers on drawn poses with known truth: errors, failures, time, and the Cramér-Rao bound."""
    from dataclasses import asdict, replace
    from time import process_time

    import numpy as np

    from uvgs_bench.accuracy.solver_benchmark import DEFINITIONS, compare_solvers, study_bound, study_speed
    from uvgs_bench.accuracy.solver_problems import draw_problems, standard_protocol
    from uvgs_bench.cli.console import console, emit_json, out
    from uvgs_bench.store.beacons import read_beacon
    from uvgs_bench.store.workspace import examples_folder

    path = examples_folder() / "calib" / "beacons" / "tetra_small.toml" if beacon is None else beacon
    chosen = standard_protocol(protocol, read_beacon(path).positions_m)
    if sigma_px is not None:
        chosen = replace(chosen, sigma_px=sigma_px)
    problems = draw_problems(chosen, poses, np.random.default_rng(seed))

    def say(name: str) -> None:
        if not quiet:
            console.print(f"[dim]{name}[/]")

    rows = compare_solvers(problems, process_time, report=say)
    bound = study_bound(problems)
    speed = study_speed(problems.first(_TIMED), process_time)
    lines = (*chosen.lines(), f"{poses} poses, seed {seed}", *DEFINITIONS)
    if as_json:
        emit_json({
            "protocol": list(lines),
            "seed": seed,
            "solvers": [asdict(row) for row in rows],
            "bound": asdict(bound),
            "speed": {**asdict(speed), "least_peer_ratio": speed.least_peer_ratio,
                      "jacobian_ratio": speed.jacobian_ratio},
        })  # fmt: skip
        return
    for line in lines:
        out.print(line, soft_wrap=True, markup=False)
    _print_rows(rows)
    _print_studies(bound, speed)


def _print_rows(rows: tuple[SolverRow, ...]) -> None:
    from rich.table import Table

    from uvgs_bench.cli.console import out

    for title, wanted in (("translation error, %", "translation_percent"), ("rotation error, %", "rotation_percent")):
        table = Table(title=title, title_justify="left", box=None, pad_edge=False)
        table.add_column("solver", no_wrap=True)
        for heading in ("mean", "σ", "median", "p95", "mean, deg", "failures", "µs"):
            table.add_column(heading, justify="right", no_wrap=True)
        for row in rows:
            spread: Spread = getattr(row, wanted)
            cells = [f"{value:.3f}" for value in (spread.mean, spread.sigma, spread.median, spread.p95)]
            angle = f"{row.rotation_deg.mean:.3f}" if wanted == "rotation_percent" else ""
            table.add_row(row.solver, *cells, angle, str(row.failures), f"{row.time_us:.1f}")
        out.print(table)


def _print_studies(bound: BoundStudy, speed: SpeedStudy) -> None:
    from uvgs_bench.cli.console import out

    peers = ", ".join(f"{name} {value:.1f}" for name, value in speed.peers_us.items())
    for line in (
        f"uvgs_lm against the Cramér-Rao bound: position {bound.position_ratio:.4f}, attitude "
        f"{bound.attitude_ratio:.4f}, whole pose {bound.pose_ratio:.4f} ± {bound.standard_error:.4f} (RMSE / bound)",
        f"wrong minima {bound.wrong_minima}, misled by noise {bound.misled}, unsolved {bound.unsolved} "
        f"of {bound.poses} poses",
        f"µs per pose through the public doors: batch refinement {speed.batch_refine_us:.2f}, batch with all starts "
        f"{speed.batch_full_us:.2f}, single refinement {speed.single_refine_us:.1f}, single with all starts "
        f"{speed.single_full_us:.1f}",
        f"batch refinement with numeric Jacobian {speed.batch_numeric_us:.2f} µs: {speed.jacobian_ratio:.1f} times the "
        "analytic one",
        f"bare cv2.solvePnP calls, µs per pose: {peers}",
        f"fastest cv2 solver that fits all points takes {speed.least_peer_ratio:.1f} times our batch refinement",
    ):
        out.print(line, soft_wrap=True, markup=False)
