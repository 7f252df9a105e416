"""``uvgs camera``: look at camera files, convert, compare and check them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.options import Force, Json, Quiet
from uvgs_bench.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from uvgs_bench.camera import Calibration, Lens

app = typer.Typer(no_args_is_help=True, help="Look at camera files; convert, compare and check them.")


@app.callback()
def camera() -> None:
    """Look at camera files; convert, compare and check them."""


@app.command("show")
def show(
    path: Annotated[Path, typer.Argument(help="Camera file (camera_info YAML, with or without uvgs:).")],
    report: Annotated[
        Path | None, typer.Option("--report", help="Folder for report.html, report.pdf and report.json.")
    ] = None,
    beacon: Annotated[
        Path | None, typer.Option("--beacon", help="Beacon file: also say what the calibration does to its pose.")
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Show a lens: numbers, doubt, field of view, provenance; as a page with maps with --report."""
    from uvgs_bench.cli.beacon_pose import pose_summary, print_pose_summary
    from uvgs_bench.cli.console import emit_json
    from uvgs_bench.store.beacons import read_beacon
    from uvgs_bench.store.calibrations import read_calibration

    calibration = read_calibration(path)
    carried = None if beacon is None else read_beacon(beacon)
    files: dict[str, str] = {}
    if report is not None:
        from uvgs_bench.cli.calibration_report import print_reports, write_calibration_report

        files = write_calibration_report(report, calibration, beacon=carried, force=force)
    if as_json:
        forecast = None if carried is None else pose_summary(calibration, carried)
        emit_json(_summary(calibration) | {"pose": forecast, "report": files or None})
        return
    _print(calibration)
    if carried is not None:
        print_pose_summary(calibration, carried)
    if files:
        print_reports(files)


@app.command("convert")
def convert(
    path: Annotated[Path, typer.Argument(help="Camera file: ROS, Kalibr, OpenCV, mrcal, COLMAP or Astrobee.")],
    out: Annotated[Path, typer.Argument(help="File to write; its ending chooses the format unless --to does.")],
    to: Annotated[str, typer.Option("--to", help="uvgs, ros, kalibr, opencv, mrcal, colmap or astrobee.")] = "",
    refit: Annotated[
        str, typer.Option("--refit", help="Refit to this lens over the covered field, and say how far off it is.")
    ] = "",
    camera_name: Annotated[str, typer.Option("--camera", help="Which camera, where the file holds several.")] = "",
    size: Annotated[str, typer.Option("--size", help="Picture size WxH in px, where the file does not say it.")] = "",
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Convert a camera file, exactly or not at all; an approximation must be asked for with --refit."""
    from rich.markup import escape

    from uvgs_bench.cli.console import emit_json, print_path
    from uvgs_bench.cli.console import out as printed
    from uvgs_bench.sessions.camera_tools import convert_camera

    done = convert_camera(
        path, out, target=to, refit_model=refit, camera=camera_name, size_px=_size_px(size), force=force
    )
    fit, lens = done.refit, done.written.lens
    if as_json:
        emit_json(
            {
                "camera": str(done.path),
                "format": done.target,
                "model": lens.model,
                "parameters": dict(zip(lens.parameter_names, lens.parameters.tolist(), strict=True)),
                "exact": fit is None,
                "rms_px": 0.0 if fit is None else fit.rms_px,
                "max_px": 0.0 if fit is None else fit.max_px,
                "covered_share": None if fit is None else fit.covered_share,
                "remarks": list(done.remarks),
            }
        )
        return
    if fit is None:
        printed.print(f"{done.source.lens.model} as {lens.model} in {done.target}: exact")
    else:
        printed.print(
            f"{done.source.lens.model} refitted as {lens.model}: RMS {fit.rms_px:.4f} px, "
            f"at most {fit.max_px:.4f} px off, over {100.0 * fit.covered_share:.1f} % of the picture"
        )
    for remark in done.remarks:
        printed.print(f"[yellow]note:[/] {escape(remark)}", soft_wrap=True)
    print_path("written", done.path)


@app.command("diff")
def diff(
    first: Annotated[Path, typer.Argument(help="Camera file of any known format.")],
    second: Annotated[Path, typer.Argument(help="Camera file for the same camera.")],
    picture: Annotated[Path | None, typer.Option("--picture", help="PNG file to draw the map into.")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """How far two calibrations of one camera put the same rays apart, after the rotation between their axes."""
    from uvgs_bench.camera.difference import difference
    from uvgs_bench.cli.camera_tables import difference_summary, print_difference
    from uvgs_bench.cli.console import emit_json, print_path
    from uvgs_bench.sessions.camera_tools import read_camera
    from uvgs_bench.store.documents import write_atomically

    found = difference(read_camera(first), read_camera(second))
    if picture is not None:
        from uvgs_bench.report.lens_difference import difference_png

        write_atomically(picture, difference_png(found, f"{second.name} minus {first.name}"), force=force)
    if as_json:
        emit_json(difference_summary(found))
        return
    print_difference(found)
    if picture is not None:
        print_path("written", picture)


@app.command("check")
def check(
    path: Annotated[Path, typer.Argument(help="Camera file to check, of any known format.")],
    source: Annotated[str, typer.Argument(help="New pictures of a board: images:DIR, video:FILE or uvc:0.")],
    board: Annotated[Path, typer.Option("--board", help="Board file.")],
    limit: Annotated[int | None, typer.Option("--limit", min=1, help="Take at most so many captures.")] = None,
    ratio: Annotated[float, typer.Option("--max-ratio", min=1.0, help="Held-out residual, new over file.")] = 1.5,
    focal: Annotated[
        float, typer.Option("--max-focal-shift-percent", min=0.0, help="Largest change of the focal length.")
    ] = 0.5,
    centre: Annotated[
        float, typer.Option("--max-centre-shift-px", min=0.0, help="Largest change of the principal point.")
    ] = 5.0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Is an existing calibration still valid? OK (exit code 0), degraded (1) or inconclusive (3), with numbers."""
    from uvgs_bench.camera.validity import ValidityLimits
    from uvgs_bench.cli.camera_tables import print_validity, validity_summary
    from uvgs_bench.cli.console import emit_json, progress_sink
    from uvgs_bench.devices.cameras.registry import open_camera
    from uvgs_bench.sessions.camera_tools import check_camera, read_camera
    from uvgs_bench.store.boards import read_board

    calibration, declared = read_camera(path), read_board(board)
    with open_camera(source) as camera, progress_sink(quiet=quiet) as sink:
        found = check_camera(
            calibration, camera, declared, limits=ValidityLimits(ratio, focal, centre), sink=sink, limit=limit
        )
    if as_json:
        emit_json(validity_summary(found))
    else:
        print_validity(found)
    codes = {"ok": ExitCode.DONE, "degraded": ExitCode.LIMITS_MISSED, "inconclusive": ExitCode.INCONCLUSIVE}
    raise typer.Exit(codes[found.verdict])


def _size_px(text: str) -> tuple[int, int] | None:
    if not text:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) > 0 and int(height) > 0):
        raise ConfigError(f"'{text}' is no picture size, expected for example 1280x960", "--size")
    return int(width), int(height)


def _field_of_view_deg(lens: Lens) -> dict[str, float | None]:
    """Full angles across the middle row, the middle column and the diagonal; None where the lens has no rays."""
    import numpy as np

    from uvgs_bench.geometry.se3 import angle_between
    from uvgs_bench.units import deg_from_rad

    right, bottom = lens.width_px - 0.5, lens.height_px - 0.5
    ends = {
        "horizontal": [[-0.5, lens.cy_px], [right, lens.cy_px]],
        "vertical": [[lens.cx_px, -0.5], [lens.cx_px, bottom]],
        "diagonal": [[-0.5, -0.5], [right, bottom]],
    }
    axis = np.array([0.0, 0.0, 1.0])
    found: dict[str, float | None] = {}
    for name, pixels in ends.items():
        rays = lens.unproject(pixels)
        # Two angles from the axis, because together they may exceed half a turn.
        angles = (
            sum(angle_between(np.ascontiguousarray(ray), axis) for ray in rays) if np.isfinite(rays).all() else None
        )
        found[name] = None if angles is None else float(deg_from_rad(angles))
    return found


def _summary(calibration: Calibration) -> dict[str, object]:
    lens, sigmas = calibration.lens, calibration.sigmas
    names = lens.parameter_names
    return {
        "camera_name": calibration.camera_name,
        "model": lens.model,
        "width_px": lens.width_px,
        "height_px": lens.height_px,
        "parameters": dict(zip(names, lens.parameters.tolist(), strict=True)),
        "sigmas": None if sigmas is None else dict(zip(names, sigmas.tolist(), strict=True)),
        "field_of_view_deg": _field_of_view_deg(lens),
        "rms_px": calibration.rms_px,
        "rms_per_axis_px": calibration.rms_per_axis_px,
        "held_out_rms_px": calibration.held_out_rms_px,
        "halves_ratio": calibration.halves_ratio,
        "view_count": calibration.view_count,
        "corner_count": calibration.corner_count,
        "rejected_count": calibration.rejected_count,
        "notes": calibration.notes,
    }


def _print(calibration: Calibration) -> None:
    from rich.markup import escape
    from rich.table import Table

    from uvgs_bench.cli.console import out

    lens, sigmas = calibration.lens, calibration.sigmas
    out.print(f"[bold]{escape(calibration.camera_name)}[/]  {lens.model}, {lens.width_px}x{lens.height_px} px")
    table = Table(box=None, pad_edge=False)
    table.add_column("parameter")
    table.add_column("value", justify="right")
    table.add_column("± 1σ", justify="right")
    for i, name in enumerate(lens.parameter_names):
        digits = 3 if i < 4 else 6
        doubt = "unknown" if sigmas is None else f"{sigmas[i]:.{digits}f}"
        table.add_row(name + (" px" if i < 4 else ""), f"{lens.parameters[i]:.{digits}f}", doubt)
    out.print(table)
    angles = _field_of_view_deg(lens)
    shown = ", ".join(f"{name} {'beyond the lens' if a is None else f'{a:.1f} deg'}" for name, a in angles.items())
    out.print(f"field of view  {shown}")
    if calibration.rms_px is None:
        out.print("no uvgs: mapping in the file: how sure these numbers are is unknown", style="yellow")
        return
    held_out = calibration.held_out_rms_px
    out.print(
        f"RMS            {calibration.rms_px:.4f} px of residual lengths, {calibration.rms_per_axis_px:.4f} px per axis"
    )
    out.print(f"held out       {'unknown' if held_out is None else f'{held_out:.4f} px'}")
    out.print(
        f"from           {calibration.view_count} views, {calibration.corner_count} corners, "
        f"{calibration.rejected_count} set aside"
    )
    for key, value in calibration.notes.items():
        out.print(f"  {escape(key)}: {escape(value)}", style="dim", soft_wrap=True)
