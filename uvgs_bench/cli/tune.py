"""``uvgs tune``: look at captures, propose sensor parameters, say why, prove them on the captures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.options import Force, Json, Quiet
from uvgs_bench.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from uvgs_bench.sessions.tune import Score, TuneResult


def tune(
    source: Annotated[str, typer.Argument(help="images:DIR, video:FILE, uvc:0 or sim:BENCH.toml?count=N.")],
    beacon: Annotated[Path, typer.Option("--beacon", help="Beacon.")],
    camera: Annotated[Path, typer.Option("--camera", help="Calibration.")],
    out: Annotated[Path | None, typer.Option("--out", help="Sensor file to write, for --config of uvgs run.")] = None,
    pictures: Annotated[Path | None, typer.Option("--pictures", help="Folder for annotated pictures.")] = None,
    config: Annotated[Path | None, typer.Option("--config", help="Sensor parameters to start from, TOML.")] = None,
    limit: Annotated[int, typer.Option("--limit", min=1, help="Look at so many captures at most.")] = 20,
    force: Force = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Propose sensor parameters for a scene, with reasons; never parameters that solve less than before."""
    from uvgs_bench.cli.console import emit_json, print_path, progress_sink
    from uvgs_bench.devices.cameras.registry import open_camera
    from uvgs_bench.sensor.config import UvgsConfig
    from uvgs_bench.sessions.tune import tune as tune_source
    from uvgs_bench.sessions.tune_file import write_pictures, write_sensor_file
    from uvgs_bench.store.beacons import read_beacon
    from uvgs_bench.store.calibrations import read_calibration
    from uvgs_bench.store.documents import read_document

    if out is not None and out.exists() and not force:
        raise ConfigError("exists already; use --force to replace it", str(out))
    calibration, lights = read_calibration(camera), read_beacon(beacon)
    start = None if config is None else read_document(config, UvgsConfig)
    with progress_sink(quiet=quiet) as sink, open_camera(source) as captures:
        result = tune_source(captures, calibration, lights, sink, start=start, limit=limit)
    drawn = [] if pictures is None else write_pictures(pictures, result, calibration, lights, force=force)
    if out is not None:
        write_sensor_file(out, result, source, force=force)
    if as_json:
        emit_json({
            **_as_tables(result), "out": None if out is None else str(out), "pictures": [str(p) for p in drawn],
        })  # fmt: skip
    else:
        _show(result)
        if out is not None:
            print_path("sensor", out)
        if drawn:
            assert pictures is not None
            print_path("pictures", pictures)
    raise typer.Exit(int(ExitCode.DONE if result.score_proposed.poses else ExitCode.INCONCLUSIVE))


def _as_tables(result: TuneResult) -> dict[str, object]:
    from dataclasses import asdict

    def score(value: Score | None) -> dict[str, object] | None:
        return None if value is None else asdict(value)

    return {
        "changes": [asdict(change) for change in result.changes],
        "before": score(result.score_before),
        "proposed": score(result.score_proposed),
        "check_before": score(result.check_before),
        "check_proposed": score(result.check_proposed),
        "noise": asdict(result.noise),
        "lights": asdict(result.lights),
        "remarks": list(result.remarks),
    }


def _show(result: TuneResult) -> None:
    from rich.markup import escape
    from rich.table import Table

    from uvgs_bench.cli.console import out
    from uvgs_bench.units import mm_from_m

    noise, lights = result.noise, result.lights
    facts = Table(box=None, pad_edge=False, show_header=False)
    facts.add_row("background", f"{noise.background_dn:.0f} DN of {noise.full_scale_dn:.0f}, uneven by "
                                f"{noise.unevenness_dn:.1f} DN")  # fmt: skip
    facts.add_row("noise", f"{noise.spatial_dn:.2f} DN between pixels, {noise.temporal_dn:.2f} DN between captures")
    facts.add_row("brightest", f"{noise.brightest_dn:.0f} DN")
    if lights.poses:
        facts.add_row("LEDs", f"{lights.least_area_px2:.0f} to {lights.greatest_area_px2:.0f} px², the dimmest "
                              f"{lights.least_height_dn:.0f} DN high, about {lights.range_m:.2f} m away")  # fmt: skip
    facts.add_row("other lights", f"{lights.others:.0f} per capture, at most {lights.brightest_other_dn:.0f} DN")
    out.print(facts)
    out.print()
    for change in result.changes:
        loss = f" [dim](without it {change.worth} poses fewer)[/]" if change.worth > 0 else ""
        out.print(f"[bold]{change.key}[/] {escape(str(change.before))} → [green]{escape(str(change.after))}[/]{loss}")
        out.print(f"  {escape(change.why)}")
    for remark in result.remarks:
        out.print(f"[cyan]·[/] {escape(remark)}")
    table = Table(box=None, pad_edge=False)
    for head in ("", "captures", "poses", "median σ mm", "misses"):
        table.add_column(head, justify="left" if head in ("", "misses") else "right")
    for name, score in (
        ("before", result.score_before),
        ("proposed", result.score_proposed),
        ("before, set aside", result.check_before),
        ("proposed, set aside", result.check_proposed),
    ):
        if score is not None:
            misses = ", ".join(f"{reason} {count}" for reason, count in score.misses.items())
            sigma = f"{mm_from_m(score.median_sigma_m):.3f}" if score.poses else "–"
            table.add_row(name, str(score.captures), str(score.poses), sigma, escape(misses))
    out.print()
    out.print(table)
