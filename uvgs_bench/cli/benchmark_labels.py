"""``uvgs benchmark labels``: how often LEDs are named wrongly, or not at all, with and without other lights."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.options import Json, Quiet, Seed

if TYPE_CHECKING:
    from uvgs_bench.sessions.label_study import LabelFigures


def labels(
    poses: Annotated[int, typer.Option("--poses", min=10, help="Clean views; other scenes get a share.")] = 10_000,
    lights: Annotated[int, typer.Option("--lights", min=1, max=8, help="Other lights strewn over the picture.")] = 3,
    beacon: Annotated[Path | None, typer.Option("--beacon", help="Beacon file; the shipped one by default.")] = None,
    config: Annotated[Path | None, typer.Option("--config", help="Sensor parameters, TOML.")] = None,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes; the figures do not depend on it.")] = 1,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Name the LEDs of drawn views with known truth: wrong poses published, refusals and why, time of the search."""
    from dataclasses import asdict

    import numpy as np
    from rich.table import Table

    from uvgs_bench.cli.console import console, emit_json, out
    from uvgs_bench.sensor.config import UvgsConfig
    from uvgs_bench.sessions.label_study import DEFINITIONS, standard_scenes, study_labels
    from uvgs_bench.store.beacons import read_beacon
    from uvgs_bench.store.documents import read_document
    from uvgs_bench.store.workspace import examples_folder
    from uvgs_bench.units import ms_from_s

    path = examples_folder() / "calib" / "beacons" / "tetra_small.toml" if beacon is None else beacon
    chosen = read_beacon(path)
    parameters = UvgsConfig() if config is None else read_document(config, UvgsConfig)
    rows: dict[str, LabelFigures] = {}
    scenes = standard_scenes(lights)
    for name, (conditions, share) in scenes.items():
        if not quiet:
            console.print(f"[dim]{name}[/]")
        count = max(1, round(poses * share))
        rows[name] = study_labels(chosen, conditions, parameters, count=count, seed=seed, workers=workers)
    if as_json:
        emit_json({
            "beacon": chosen.name, "seed": seed, "definitions": list(DEFINITIONS),
            "scenes": {name: {"conditions": asdict(scenes[name][0]), **row.summary()} for name, row in rows.items()},
        })  # fmt: skip
        return
    for line in (f"beacon {chosen.name}, seed {seed}", *DEFINITIONS):
        out.print(line, soft_wrap=True, markup=False)
    table = Table(box=None, pad_edge=False, padding=(0, 0, 0, 1))
    table.add_column("scene", min_width=12)
    for heading in ("views", "wrong", "wrong\n%", "un-\nflagged\n%", "flagged\n%", "refused\n%", "ms"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, row in rows.items():
        shares = (row.wrong_share, row.wrong_unflagged / row.views, row.flagged / row.views, row.refused_share)
        times = f"{ms_from_s(float(np.median(row.view_s))):.2f}" if row.view_s else "-"
        table.add_row(name, str(row.views), str(row.wrong), *(f"{100.0 * share:.3f}" for share in shares), times)
    out.print(table)
    for name, row in rows.items():
        reasons = ", ".join(f"{reason} {count}" for reason, count in row.refused.most_common()) or "none"
        out.print(f"{name}: refused {reasons}", soft_wrap=True, markup=False)
