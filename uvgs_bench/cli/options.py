"""Options that mean the same in every command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON object on stdout; progress and remarks go to stderr.")
]
Force = Annotated[bool, typer.Option("--force", help="Replace existing output files.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of everything random.")]
IntervalSeed = Annotated[
    int | None, typer.Option("--seed", min=0, help="Seed of the intervals.  [default: that of the run]")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress bars.")]
BenchFile = Annotated[Path, typer.Option("--bench", help="Bench file: camera, beacon, gantry and mount.")]

DEFAULT_BENCH = Path("calib/bench.toml")


def given_options(context: typer.Context) -> frozenset[str]:
    """Names of the parameters that were written on the command line."""
    return frozenset(
        name
        for name in context.params
        if (where := context.get_parameter_source(name)) is not None and where.name == "COMMANDLINE"
    )
