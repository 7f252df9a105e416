"""``uvgs init``: a workspace from the examples the package carries."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from uvgs_bench.cli.options import Force, Json


def init(
    folder: Annotated[Path, typer.Argument(help="The new workspace.")] = Path(),
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Make a workspace: a simulated bench, boards, beacons and procedures to start from."""
    from uvgs_bench.cli.console import emit_json, out, print_path
    from uvgs_bench.store.workspace import create_workspace

    files = create_workspace(folder, force=force)
    if as_json:
        emit_json({"workspace": str(folder), "files": [str(path) for path in files]})
        return
    print_path("workspace", folder)
    for path in files:
        out.print(f"  {path}", soft_wrap=True)
    out.print("Next: [bold]uvgs gantry-sweep procedures/demo_grid.toml[/] inside it, or [bold]uvgs doctor[/].")
