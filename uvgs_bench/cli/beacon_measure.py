"""``uvgs beacon measure``: where the LEDs of a beacon truly are, with doubt."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.options import Force, Json, Quiet
from uvgs_bench.errors import ConfigError

if TYPE_CHECKING:
    from uvgs_bench.beacon import Beacon
    from uvgs_bench.beacon.measure import Caliper, MeasureConfig
    from uvgs_bench.sessions.measure_beacon import MeasuredBeacon


def measure(
    source: Annotated[str, typer.Argument(help="A run folder, or pictures: images:DIR, video:FILE, uvc:0.")],
    out: Annotated[Path, typer.Option("--out", help="Beacon file to write.")],
    camera: Annotated[Path | None, typer.Option("--camera", help="Camera file.  [default: the run's own]")] = None,
    nominal: Annotated[Path | None, typer.Option("--nominal", help="Nominal beacon.  [default: the run's own]")] = None,
    by: Annotated[
        str, typer.Option("--by", help="gantry, board or free.  [default: gantry for a run, board with --board]")
    ] = "",
    board: Annotated[Path | None, typer.Option("--board", help="Board file: a board is fixed to the beacon.")] = None,
    caliper: Annotated[
        list[str] | None, typer.Option("--caliper", help="A distance in mm, 'top-left=104.2'; may be repeated.")
    ] = None,
    caliper_sigma: Annotated[float, typer.Option("--caliper-sigma", min=1e-3, help="Its deviation, mm.")] = 0.05,
    frame: Annotated[
        str, typer.Option("--frame", help="nominal, board, gantry, or LEDs 'origin,on x,in the x-y plane'.")
    ] = "nominal",
    nominal_error: Annotated[
        float, typer.Option("--nominal-error", min=0.0, help="How far LEDs may be from nominal, mm.")
    ] = 2.0,
    nominal_sigma: Annotated[
        float, typer.Option("--nominal-sigma", min=1e-3, help="Deviation of well placed nominal LEDs, mm (scale).")
    ] = 0.1,
    station_sigma: Annotated[
        float, typer.Option("--station-sigma", min=1e-4, help="Deviation of a stop of the gantry, mm.")
    ] = 0.03,
    scale_ppm: Annotated[
        float, typer.Option("--scale-ppm", min=1.0, help="Deviation of the gantry's or the board's scale, ppm.")
    ] = 200.0,
    squareness: Annotated[
        float, typer.Option("--squareness-mrad", min=1e-3, help="Deviation of the gantry's squareness, mrad.")
    ] = 0.2,
    emission_shift: Annotated[
        bool,
        typer.Option("--emission-shift", help="Also estimate how emission centres travel along the LEDs' axes."),
    ] = False,
    fixed_lens: Annotated[bool, typer.Option("--fixed-lens", help="Take the camera file as exact.")] = False,
    limit: Annotated[int | None, typer.Option("--limit", min=1, help="Take at most so many pictures.")] = None,
    report: Annotated[
        Path | None, typer.Option("--report", help="Folder for report.html, report.pdf and report.json.")
    ] = None,
    force: Force = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Measure the LED positions of a beacon from pictures or from a gantry sweep."""
    from uvgs_bench.beacon.frames import FrameChoice
    from uvgs_bench.beacon.measure import MeasureConfig
    from uvgs_bench.cli.console import emit_json, print_path, progress_sink
    from uvgs_bench.sessions.measure_beacon import measure_from_pictures, measure_from_run, read_pictures
    from uvgs_bench.store.beacons import read_beacon, write_beacon
    from uvgs_bench.store.boards import read_board
    from uvgs_bench.store.calibrations import read_calibration
    from uvgs_bench.store.run import is_run, read_run
    from uvgs_bench.units import m_from_mm, rad_from_mrad

    if out.exists() and not force:
        raise ConfigError("exists already; use --force to replace it", str(out))
    if report is not None:
        from uvgs_bench.report import check_replaceable

        check_replaceable(report, force=force)
    run = read_run(Path(source)) if is_run(Path(source)) else None
    if run is None and (camera is None or nominal is None):
        raise ConfigError("is no run folder, so --camera and --nominal are needed", source)
    chosen = by or ("gantry" if run is not None else "board" if board is not None else "free")
    sources = ("gantry", "free") if run is not None else ("board", "free")
    if chosen not in sources:
        raise ConfigError(
            f"'{chosen}' does not fit this source: gantry needs a run folder, board needs pictures", "--by"
        )
    if (chosen == "board") != (board is not None):
        raise ConfigError("is needed with --by board and only there", "--board")
    meant = read_beacon(nominal) if nominal is not None else run.beacon  # type: ignore[union-attr]
    calibration = read_calibration(camera) if camera is not None else run.calibration  # type: ignore[union-attr]
    config = MeasureConfig(
        chosen,  # type: ignore[arg-type]
        FrameChoice.parse(frame),
        tuple(_caliper(text, meant, m_from_mm(caliper_sigma)) for text in caliper or ()),
        station_sigma_m=m_from_mm(station_sigma),
        scale_sigma=scale_ppm * 1e-6,
        squareness_sigma_rad=rad_from_mrad(squareness),
        board_scale_sigma=scale_ppm * 1e-6,
        nominal_sigma_m=m_from_mm(nominal_sigma),
        is_lens_fixed=fixed_lens,
        is_shift_free=emission_shift,
    )
    error_m = m_from_mm(nominal_error)
    name = out.stem
    with progress_sink(quiet=quiet) as sink:
        if run is not None:
            result = measure_from_run(run, meant, calibration, config, nominal_error_m=error_m, name=name, sink=sink)
        else:
            declared = None if board is None else read_board(board)
            result = measure_from_pictures(
                read_pictures(source, limit), meant, calibration, config,
                board=declared, nominal_error_m=error_m, name=name, sink=sink,
            )  # fmt: skip
    write_beacon(out, result.measurement.beacon, force=force, comment=_provenance(result, source))
    files: dict[str, str] = {}
    if report is not None:
        from uvgs_bench.cli.beacon_report import write_measurement_report

        files = write_measurement_report(report, result, meant, calibration, source, force=force)
    if as_json:
        emit_json(_record(result, config) | {"file": str(out), "report": files or None})
        return
    _print(result)
    print_path("beacon", out)
    for kind, path in files.items():
        print_path(kind, path)


def _caliper(text: str, beacon: Beacon, sigma_m: float) -> Caliper:
    from uvgs_bench.beacon.measure import Caliper
    from uvgs_bench.units import m_from_mm

    pair, _, value = text.partition("=")
    names = beacon.led_names
    # A name may itself hold a dash.
    found = [(a, b) for a in names for b in names if a != b and pair.strip() == f"{a}-{b}"]
    try:
        distance_mm = float(value)
    except ValueError:
        distance_mm = 0.0
    if len(found) != 1 or not distance_mm > 0.0:
        raise ConfigError(
            f"expected two LEDs and a distance in mm like '{names[0]}-{names[1]}=104.2' with LEDs of "
            f"{', '.join(names)}, got '{text}'", "--caliper",
        )  # fmt: skip
    return Caliper(*found[0], m_from_mm(distance_mm), sigma_m)


def _provenance(result: MeasuredBeacon, source: str) -> str:
    from uvgs_bench.sessions.measure_beacon import made_by
    from uvgs_bench.units import mm_from_m

    m = result.measurement
    lines = [
        f"Measured by {m.by} from {source}: {m.view_count} views. {made_by()}",
        f"Scale: {m.scale_source}.",
        f"Frame: {m.gauge}.",
        f"Worst distance ± {mm_from_m(m.worst_sigma_m):.4f} mm; centroids ± {m.sigma_px:.3f} px.",
        *(f"{line}." for line in _shift_lines(result)),
        *(f"Warning: {line}" for line in m.warnings),
    ]
    return "\n".join(line.replace("\n", " ") for line in lines)


def _shift_lines(result: MeasuredBeacon) -> list[str]:
    """What was adjusted about emission centres, for people."""
    from uvgs_bench.units import mm_from_m

    m = result.measurement
    if not m.is_shift_free:
        return []
    rows = [row for row in m.leds if row.shift_sigma_m > 0.0]
    each = ", ".join(f"{r.name} {mm_from_m(r.shift_m):+.3f} ± {mm_from_m(r.shift_sigma_m):.3f} mm" for r in rows)
    return [f"Positions as seen along each axis; from the side emission centres come forward by (1 - cos) times {each}"]


def _record(result: MeasuredBeacon, config: MeasureConfig) -> dict[str, object]:
    from uvgs_bench.units import deg_from_rad, mm_from_m

    m = result.measurement
    return {
        "by": m.by,
        "scale_source": m.scale_source,
        "gauge": m.gauge,
        "frame": config.frame.kind,
        "views": m.view_count,
        "pictures": result.captures,
        "named_with_nominal": result.named_first,
        "named": result.named,
        "rounds": result.rounds,
        "misses": result.misses,
        "sigma_px": m.sigma_px,
        "redundancy": m.redundancy,
        "condition": m.condition,
        "mirror_margin": m.mirror_margin,
        "distances": [
            {
                "leds": [d.first, d.second],
                "distance_mm": mm_from_m(d.distance_m),
                "sigma_mm": mm_from_m(d.sigma_m),
                "nominal_mm": mm_from_m(d.nominal_m),
                "caliper_mm": None if d.caliper_m is None else mm_from_m(d.caliper_m),
            }
            for d in m.distances
        ],
        "leds": [
            {
                "name": row.name,
                "position_mm": mm_from_m(led.position_m),
                "off_nominal_mm": mm_from_m(row.deviation_m),
                "sightings": row.count,
                "rejected": row.rejected,
                "rms_px": row.rms_px,
                "widest_view_deg": deg_from_rad(row.max_angle_rad),
                "wander_mm": mm_from_m(row.shift_m),
                "wander_sigma_mm": mm_from_m(row.shift_sigma_m),
            }
            for row, led in zip(m.leds, m.beacon.leds, strict=True)
        ],
        "is_shift_free": m.is_shift_free,
        "rejected": [{"view": view, "led": led, "residual_px": px} for view, led, px in m.rejected],
        "warnings": list(m.warnings),
    }


def _print(result: MeasuredBeacon) -> None:
    from rich.markup import escape
    from rich.table import Table

    from uvgs_bench.cli.console import out
    from uvgs_bench.units import mm_from_m

    m = result.measurement
    table = Table(title=f"distances by {m.by}, {m.view_count} views", box=None, pad_edge=False)
    for heading in ("LEDs", "mm", "± mm (1 sigma)", "minus nominal", "minus caliper"):
        table.add_column(heading, justify="left" if heading == "LEDs" else "right")
    for d in m.distances:
        by_hand = "" if d.caliper_m is None else f"{mm_from_m(d.distance_m - d.caliper_m):+.3f}"
        table.add_row(
            f"{d.first}-{d.second}", f"{mm_from_m(d.distance_m):.3f}", f"{mm_from_m(d.sigma_m):.3f}",
            f"{mm_from_m(d.distance_m - d.nominal_m):+.3f}", by_hand,
        )  # fmt: skip
    out.print(table)
    leds = Table(box=None, pad_edge=False)
    for heading in ("LED", "off nominal mm", "rms px", "sightings", "set aside"):
        leds.add_column(heading, justify="left" if heading == "LED" else "right")
    for row in m.leds:
        leds.add_row(
            row.name, f"{mm_from_m(row.deviation_m):.3f}", f"{row.rms_px:.3f}", str(row.count), str(row.rejected)
        )
    out.print(leds)
    out.print(f"scale        {escape(m.scale_source)}", soft_wrap=True)
    out.print(f"frame        {escape(m.gauge)}", soft_wrap=True)
    out.print(
        f"pictures     {result.named} of {result.captures} named ({result.named_first} with the nominal beacon); "
        f"centroids ± {m.sigma_px:.3f} px",
        soft_wrap=True,
    )
    for line in _shift_lines(result):
        out.print(f"emission     {escape(line)}", soft_wrap=True)
    for line in m.warnings:
        out.print(f"[yellow]warning:[/] {escape(line)}", soft_wrap=True)
