"""``uvgs doctor``: what is here, what is missing, and which feature that costs."""

from __future__ import annotations

import typer

from uvgs_bench.cli.options import Json
from uvgs_bench.errors import ExitCode


def doctor(as_json: Json = False) -> None:
    """Show versions, OpenCV's abilities, serial ports, cameras, fonts, and what is missing for which feature."""
    from rich.markup import escape
    from rich.table import Table

    from uvgs_bench.cli.console import emit_json, out
    from uvgs_bench.sessions.doctor import examine

    findings = examine()
    if as_json:
        lines = [{"area": f.area, "item": f.item, "state": f.state, "text": f.text} for f in findings]
        emit_json({"is_usable": all(f.state != "broken" for f in findings), "findings": lines})
    else:
        colour = {"ok": "green", "missing": "yellow", "broken": "red"}
        table = Table(box=None, pad_edge=False, show_header=True, header_style="bold")
        table.add_column("area", no_wrap=True)
        table.add_column("item", overflow="fold")
        table.add_column("state", no_wrap=True)
        table.add_column("what it means", overflow="fold")
        for finding in findings:
            shown = f"[{colour[finding.state]}]{finding.state}[/]"
            table.add_row(finding.area, escape(finding.item), shown, escape(finding.text))
        out.print(table)
    if any(finding.state == "broken" for finding in findings):
        raise typer.Exit(int(ExitCode.INPUT))
