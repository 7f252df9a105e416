"""``uvgs benchmark centroids``: how good the centroids are, next to the Cramér-Rao bound."""

from __future__ import annotations

from typing import Annotated

import typer

from uvgs_bench.cli.options import Json, Quiet, Seed


def centroids(
    pictures: Annotated[int, typer.Option("--pictures", min=1, help="Pictures of each kind, 165 spots each.")] = 4,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Measure drawn spots, clear and clipped, and compare their errors with the bound and with what is stated."""
    from dataclasses import asdict

    from rich.table import Table

    from uvgs_bench.cli.console import emit_json, out, progress_sink
    from uvgs_bench.sessions.centroid_study import study_centroids

    with progress_sink(quiet=quiet) as sink:
        rows = study_centroids(sink, pictures=pictures, seed=seed)
    if as_json:
        emit_json({"seed": seed, "rows": [{**asdict(row), "over_bound": row.over_bound} for row in rows]})
        return
    table = Table(title=f"centroids per axis, seed {seed}", box=None, pad_edge=False)
    for name in ("peak DN", "width px", "clipped", "spots", "missed", "rms px", "bound px", "rms/bound", "rms/stated"):
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(
            f"{row.peak_dn:.0f}", f"{row.sigma_px:.1f}", "yes" if row.is_clipped else "", str(row.spots),
            str(row.missed), f"{row.rms_px:.4f}", f"{row.bound_px:.4f}", f"{row.over_bound:.2f}",
            f"{row.normalised_rms:.2f}",
        )  # fmt: skip
    out.print(table)
