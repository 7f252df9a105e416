"""``uvgs benchmark missions``: the paper's missions on the simulated bench, one table of figures."""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum
from math import isfinite
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.options import Json, Quiet, Seed

if TYPE_CHECKING:
    from uvgs_bench.sessions.figures_table import Figure


class Part(StrEnum):
    """A part of the table."""

    MANEUVERS = "maneuvers"
    HANDOVER = "handover"
    FUSION = "fusion"
    FOLLOW = "follow"


def missions(
    part: Annotated[
        list[Part] | None, typer.Option("--part", help="Only this part; may be given again.  [default: all]")
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Replay the paper's missions on the simulated bench: maneuvers, hand-over, fusion, leader and follower.

    Everything is seeded; pictures are drawn and solved by the sensor as it is. Exit code 1 when a figure is not met.
    """
    from rich.table import Table

    from uvgs_bench.cli.console import emit_json, out, progress_sink
    from uvgs_bench.errors import ExitCode
    from uvgs_bench.sessions.mission_benchmark import mission_figures

    with progress_sink(quiet=quiet) as sink:
        found = dict(mission_figures(seed, tuple(part or ()), sink))
    if as_json:
        rows = [
            {
                "part": name,
                "of": heading,
                "name": figure.name.strip(),
                "wanted": figure.wanted,
                "measured": figure.measured if isfinite(figure.measured) else None,
                "unit": figure.unit,
                "is_met": figure.is_met,
            }
            for name, figures in found.items()
            for heading, figure in _with_headings(figures)
        ]
        emit_json({"seed": seed, "figures": rows})
    else:
        table = Table(box=None, pad_edge=False)
        table.add_column("figure", overflow="fold")
        table.add_column("wanted", justify="right")
        table.add_column("measured", justify="right")
        table.add_column("")
        for figures in found.values():
            for figure in figures:
                said = f"{figure.measured:.4g} {figure.unit}".strip() if isfinite(figure.measured) else "unknown"
                verdict = "" if figure.is_met is None else "met" if figure.is_met else "NOT MET"
                table.add_row(figure.name, figure.wanted, said, verdict)
            table.add_section()
        out.print(table)
    is_missed = any(figure.is_met is False for figures in found.values() for figure in figures)
    raise typer.Exit(int(ExitCode.LIMITS_MISSED if is_missed else ExitCode.DONE))


def _with_headings(figures: tuple[Figure, ...]) -> Iterator[tuple[str, Figure]]:
    """Each figure with the name of the one it is indented under, empty for one that is not."""
    heading = ""
    for figure in figures:
        is_part = figure.name.startswith(" ")
        heading = heading if is_part else figure.name
        yield heading if is_part else "", figure
