"""``uvgs beacon``: look at a beacon file and its weaknesses."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from uvgs_bench.cli.beacon_measure import measure
from uvgs_bench.cli.beacon_pair import pair
from uvgs_bench.cli.options import Force, Json
from uvgs_bench.errors import ConfigError

app = typer.Typer(help="Measure a beacon, show it, and check whether it can be told apart.", no_args_is_help=True)
app.command("measure")(measure)
app.command("pair")(pair)
_File = Annotated[Path, typer.Argument(help="Beacon file, TOML.")]


@app.command("show")
def show(
    file: _File,
    picture: Annotated[Path | None, typer.Option("--picture", help="Also draw LEDs and frame: PNG, PDF, SVG.")] = None,
    as_json: Json = False,
    force: Force = False,
) -> None:
    """Print the LEDs of a beacon, and draw them in their frame."""
    from rich.table import Table

    from uvgs_bench.beacon.checks import size_m, thickness_m
    from uvgs_bench.cli.console import emit_json, out
    from uvgs_bench.store.beacons import read_beacon
    from uvgs_bench.units import deg_from_rad, mm_from_m

    beacon = read_beacon(file)
    if picture is not None:
        from uvgs_bench.report.beacon_page import write_beacon_picture

        _refuse_existing(picture, force)
        write_beacon_picture(picture, beacon)
    size_mm, thickness_mm = mm_from_m(size_m(beacon)), mm_from_m(thickness_m(beacon))
    if as_json:
        leds = [{"name": led.name, "position_mm": mm_from_m(led.position_m)} for led in beacon.leds]
        emit_json({
            "name": beacon.name, "hue": beacon.hue, "leds": leds, "size_mm": size_mm, "thickness_mm": thickness_mm,
            "is_measured": beacon.covariance_m2 is not None,
        })  # fmt: skip
        return
    table = Table(
        title=f"{beacon.name}: {size_mm:.1f} mm across, {thickness_mm:.1f} mm thick", box=None, pad_edge=False
    )
    for heading in ("LED", "x mm", "y mm", "z mm", "half angle deg", "diameter mm"):
        table.add_column(heading, justify="left" if heading == "LED" else "right")
    for led in beacon.leds:
        half = "" if led.half_angle_rad is None else f"{deg_from_rad(led.half_angle_rad):.1f}"
        diameter = "" if led.diameter_m is None else f"{mm_from_m(led.diameter_m):.2f}"
        table.add_row(led.name, *(f"{v:.3f}" for v in mm_from_m(led.position_m)), half, diameter)
    out.print(table)


def _refuse_existing(path: Path, force: bool) -> None:
    if path.exists() and not force:
        raise ConfigError("exists already; use --force to replace it", str(path))


@app.command("check")
def check(
    file: _File,
    camera: Annotated[
        Path | None, typer.Option("--camera", help="Camera file: forecast accuracy and safety of labels with it.")
    ] = None,
    near: Annotated[float, typer.Option("--near", help="Nearest range, m.")] = 0.4,
    far: Annotated[float, typer.Option("--far", help="Farthest range, m.")] = 3.0,
    tilt: Annotated[float, typer.Option("--tilt", help="Widest tilt, degrees.")] = 45.0,
    sigma_px: Annotated[float, typer.Option("--sigma-px", min=1e-3, help="Deviation of a centroid, px.")] = 0.1,
    report: Annotated[
        Path | None, typer.Option("--report", help="Folder for report.html, report.pdf and report.json.")
    ] = None,
    as_json: Json = False,
    force: Force = False,
) -> None:
    """Warn, with numbers, when a beacon is flat, too symmetric, or its own mirror image; with a camera, forecast it."""
    from rich.markup import escape

    from uvgs_bench.beacon import check_beacon
    from uvgs_bench.cli.console import emit_json, out, print_path
    from uvgs_bench.errors import ExitCode
    from uvgs_bench.store.beacons import read_beacon
    from uvgs_bench.units import mm_from_m

    beacon = read_beacon(file)
    warnings = check_beacon(beacon)
    record: dict[str, object] = {
        "warnings": [
            {"kind": w.kind, "value_mm": mm_from_m(w.value_m), "limit_mm": mm_from_m(w.limit_m), "text": w.text}
            for w in warnings
        ]
    }
    lines: list[str] = []
    files: dict[str, str] = {}
    if camera is not None:
        from uvgs_bench.cli.beacon_forecast import forecast

        lines, more, files = forecast(beacon, warnings, camera, near, far, tilt, sigma_px, report, force)
        record |= more | {"report": files or None}
    elif report is not None:
        raise ConfigError("needs --camera", "--report")
    if as_json:
        emit_json(record)
    else:
        for warning in warnings:
            out.print(f"[yellow]{warning.kind}:[/] {escape(warning.text)}", soft_wrap=True)
        if not warnings:
            out.print("[green]no weakness found[/]")
        for line in lines:
            out.print(escape(line), soft_wrap=True)
        for name, path in files.items():
            print_path(name, path)
    raise typer.Exit(int(ExitCode.LIMITS_MISSED if warnings else ExitCode.DONE))
