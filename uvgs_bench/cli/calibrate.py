"""``uvgs calibrate``: from pictures of a board to a camera file, if the pictures deserve one."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.options import Json, Quiet
from uvgs_bench.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from uvgs_bench.camera import CalibrationResult
    from uvgs_bench.camera.calibration import Verdict


def calibrate(
    source: Annotated[
        str, typer.Argument(help="Pictures of the board: images:DIR, video:FILE, bag:FILE, or a live camera as uvc:0.")
    ],
    board: Annotated[Path, typer.Option("--board", help="Board file.")],
    out: Annotated[Path, typer.Option("--out", help="Camera file to write (camera_info YAML).")],
    model: Annotated[
        str, typer.Option("--model", help="plumb_bob, rational_polynomial, thin_prism, equidistant, fov, or auto.")
    ] = "plumb_bob",
    name: Annotated[str, typer.Option("--name", help="Camera name; the file's own name by default.")] = "",
    glob: Annotated[str, typer.Option("--glob", help="Only pictures of this pattern, for example 'left*.jpg'.")] = "",
    no_reject: Annotated[
        bool, typer.Option("--no-reject", help="Plain least squares: keep every corner, one noise for all.")
    ] = False,
    board_shape: Annotated[
        bool, typer.Option("--board-shape", help="Also estimate the bow and the stretch of the printed board.")
    ] = False,
    limit: Annotated[int | None, typer.Option("--limit", min=1, help="Take at most so many captures.")] = None,
    keep: Annotated[
        Path | None, typer.Option("--keep", help="Folder for the pictures taken from a live camera (PNG).")
    ] = None,
    beacon: Annotated[
        Path | None, typer.Option("--beacon", help="Beacon file: also say what the calibration does to its pose.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", help="Folder for report.html, report.pdf and report.json.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace files, and write a camera file that is not usable, saying so.")
    ] = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Calibrate a camera from pictures of a board.

    A live camera takes a picture by itself whenever the board, held still, shows something new; what is still missing
    is said, and it ends when that is enough.

    Exit code 0: usable, at least within a radius. 1: not usable. 3: too few pictures to tell. With 1 and 3 no camera
    file is written unless --force is given; it then carries the verdict. A report asked for is written in any case.
    """
    from uvgs_bench.camera import LENSES
    from uvgs_bench.cli.beacon_pose import pose_summary, print_pose_summary
    from uvgs_bench.cli.console import console, emit_json, print_path, progress_sink
    from uvgs_bench.cli.live_views import live_sink
    from uvgs_bench.devices.cameras.registry import open_camera
    from uvgs_bench.sessions.calibrate import AUTO_LENS, calibrate_from_source
    from uvgs_bench.store.beacons import read_beacon
    from uvgs_bench.store.boards import read_board
    from uvgs_bench.store.calibrations import write_calibration
    from uvgs_bench.store.documents import check_writable

    check_writable(out, force=force)
    if report is not None:
        from uvgs_bench.report import check_replaceable

        check_replaceable(report, force=force)
    if model not in (*LENSES, AUTO_LENS):
        raise ConfigError(f"unknown lens model '{model}', expected one of {', '.join(LENSES)}", "--model")
    if glob:
        source += ("&" if "?" in source else "?") + f"glob={glob}"
    declared = read_board(board)
    carried = None if beacon is None else read_beacon(beacon)
    with open_camera(source) as camera, (live_sink if camera.is_live else progress_sink)(quiet=quiet) as sink:
        result = calibrate_from_source(
            camera,
            declared,
            model,
            sink=sink,
            camera_name=name or out.stem,
            reject_outliers=not no_reject,
            limit=limit,
            is_board_free=board_shape,
            keep=keep,
        )
    verdict = result.calibration.verdict
    assert verdict is not None
    if not as_json:
        # Before writing, so that a full disk takes the file but not the numbers.
        _show(result)
        _show_verdict(verdict)
        if carried is not None:
            print_pose_summary(result.calibration, carried)
    is_written = verdict.is_usable or force
    if is_written:
        write_calibration(out, result.calibration, force=force)
    files: dict[str, str] = {}
    if report is not None:
        from uvgs_bench.cli.calibration_report import print_reports, write_calibration_report

        shown = source if not camera.is_live else f"images:{keep}" if keep is not None else ""
        files = write_calibration_report(report, result.calibration, result, carried, shown, force=force)
        if not as_json:
            print_reports(files)
    if as_json:
        forecast = None if carried is None else pose_summary(result.calibration, carried)
        emit_json(_summary(result, out if is_written else None) | {"pose": forecast, "report": files or None})
    elif is_written:
        print_path("written", out)
    else:
        console.print(f"no camera file written: --force writes {out} with this verdict in it", markup=False)
    if not verdict.is_usable:
        raise typer.Exit(ExitCode.INCONCLUSIVE if verdict.word == "inconclusive" else ExitCode.LIMITS_MISSED)


def _summary(result: CalibrationResult, out: Path | None) -> dict[str, object]:
    from uvgs_bench.units import deg_from_rad, mrad_from_rad

    fitted, everything = result.calibration, result.all_corners
    halves, verdict, held_out = result.split_half, fitted.verdict, fitted.held_out_rms_px
    assert verdict is not None
    assert fitted.sigmas is not None
    names = fitted.lens.parameter_names
    return {
        "camera": None if out is None else str(out),
        "verdict": verdict.word,
        "usable_radius_px": verdict.radius_px,
        "reasons": list(verdict.reasons),
        "next_pictures": list(verdict.next_pictures),
        "model": fitted.lens.model,
        "width_px": fitted.lens.width_px,
        "height_px": fitted.lens.height_px,
        "parameters": dict(zip(names, fitted.lens.parameters.tolist(), strict=True)),
        "sigmas": dict(zip(names, fitted.sigmas.tolist(), strict=True)),
        "rms_px": fitted.rms_px,
        "rms_per_axis_px": fitted.rms_per_axis_px,
        "rms_mrad": float(mrad_from_rad(result.structure.rms_rad)),
        "held_out_rms_px": held_out if held_out is not None and isfinite(held_out) else None,
        "held_out_rms_mrad": _in_mrad(result, held_out),
        "split_half": None
        if halves is None
        else {
            "difference_px": halves.difference_px,
            "difference_mrad": _in_mrad(result, halves.difference_px),
            "predicted_px": halves.predicted_px,
            "ratio": halves.ratio,
        },
        "neighbour_correlation": result.structure.neighbour_correlation,
        "systematic_px": result.structure.systematic_px,
        "kurtosis": result.structure.kurtosis,
        "ring_radius_px": result.structure.ring_radius_px.tolist(),
        "ring_rms_px": result.structure.ring_rms_px.tolist(),
        "covered_radius_px": result.coverage.radius_px,
        "coverage": result.coverage.counts.tolist(),
        "tilt_deg": [float(deg_from_rad(angle)) for angle in result.coverage.tilts_rad],
        "distance_m": result.coverage.distances_m.tolist(),
        "board_shape": None if result.board_shape is None else result.board_shape.tolist(),
        "rms_all_corners_px": everything.rms_px,
        "parameters_all_corners": dict(zip(names, everything.lens.parameters.tolist(), strict=True)),
        "views": dict(zip(result.view_names, result.view_rms_px.tolist(), strict=True)),
        "corner_count": fitted.corner_count,
        "condition": result.condition,
        "rejected": [
            {"view": c.view, "index": c.index, "u_px": c.u_px, "v_px": c.v_px, "residual_px": c.residual_px}
            for c in result.rejected
        ],
        "misses": [{"picture": m.name, "reason": m.reason, "detail": m.detail} for m in result.misses],
        "warnings": list(result.warnings),
    }


def _in_mrad(result: CalibrationResult, error_px: float | None) -> float | None:
    """Pixels as an angle, at the mean scale of the seen corners."""
    from uvgs_bench.units import mrad_from_rad

    rms_px = result.calibration.rms_px
    if error_px is None or not rms_px or not isfinite(error_px):
        return None
    return float(mrad_from_rad(error_px * result.structure.rms_rad / rms_px))


def _mrad_text(result: CalibrationResult, error_px: float) -> str:
    mrad = _in_mrad(result, error_px)
    return "no angle" if mrad is None else f"{mrad:.3f} mrad"


def _show(result: CalibrationResult) -> None:
    from collections import Counter

    from rich.markup import escape
    from rich.table import Table

    from uvgs_bench.cli.console import out
    from uvgs_bench.units import deg_from_rad, mm_from_m, mrad_from_rad

    fitted, everything = result.calibration, result.all_corners
    assert fitted.sigmas is not None
    assert fitted.rms_px is not None
    table = Table(box=None, pad_edge=False)
    table.add_column(fitted.lens.model, style="bold")
    table.add_column("value", justify="right")
    table.add_column("± 1σ", justify="right")
    if result.rejected:
        table.add_column("with all corners", justify="right", style="dim")
    for i, name in enumerate(fitted.lens.parameter_names):
        digits = 3 if i < 4 else 6
        cells = [f"{fitted.lens.parameters[i]:.{digits}f}", f"{fitted.sigmas[i]:.{digits}f}"]
        out_of_all = [f"{everything.lens.parameters[i]:.{digits}f}"] if result.rejected else []
        table.add_row(name + (" px" if i < 4 else ""), *cells, *out_of_all)
    out.print(table)
    mrad = float(mrad_from_rad(result.structure.rms_rad))
    per_axis = f"{fitted.rms_per_axis_px:.4f} px per axis = {mrad:.3f} mrad"
    out.print(f"RMS          {fitted.rms_px:.4f} px (of residual lengths) = {per_axis}")
    if result.rejected:
        out.print(f"  all corners {everything.rms_px:.4f} px before outliers were set aside", style="dim")
    unseen = fitted.held_out_rms_px
    held_out = "too few views" if unseen is None else f"{unseen:.4f} px = {_mrad_text(result, unseen)}"
    out.print(f"held out     {held_out}")
    halves = result.split_half
    if halves is not None:
        out.print(
            f"two halves   differ by {halves.difference_px:.3f} px = {_mrad_text(result, halves.difference_px)}, "
            f"predicted {halves.predicted_px:.3f} px: ratio {halves.ratio:.2f}"
        )
    structure, covered = result.structure, result.coverage
    out.print(
        f"residuals    neighbours correlate {structure.neighbour_correlation:.2f}, kurtosis {structure.kurtosis:.1f}"
    )
    tilts, distances = deg_from_rad(covered.tilts_rad), covered.distances_m
    out.print(
        f"coverage     to {covered.radius_px:.0f} of {covered.picture_radius_px:.0f} px, tilts {tilts.min():.0f} to "
        f"{tilts.max():.0f} deg, distances {distances.min():.2f} to {distances.max():.2f} m"
    )
    if result.board_shape is not None:
        (bow_x, bow_y, stretch), (bow_x_sigma, bow_y_sigma, stretch_sigma) = result.board_shape
        bows = " and ".join(
            f"{mm_from_m(bow):.2f} ± {mm_from_m(sigma):.2f} mm along {axis}"
            for axis, bow, sigma in (("x", bow_x, bow_x_sigma), ("y", bow_y, bow_y_sigma))
        )
        out.print(f"board        bow {bows}; y longer by {100 * stretch:.3f} ± {100 * stretch_sigma:.3f} %")
    missed = Counter(miss.reason for miss in result.misses)
    reasons = "".join(f", {count} {escape(reason)}" for reason, count in missed.most_common())
    out.print(f"views        {fitted.view_count} used{reasons}")
    out.print(f"corners      {fitted.corner_count} used, {fitted.rejected_count} set aside")
    for corner in result.rejected[:5]:
        where = f"({corner.u_px:.1f}, {corner.v_px:.1f})"
        out.print(
            f"  {escape(corner.view)} corner {corner.index} at {where}: {corner.residual_px:.2f} px off", style="dim"
        )
    if len(result.rejected) > 5:
        out.print(f"  and {len(result.rejected) - 5} more (see --json)", style="dim")


def _show_verdict(verdict: Verdict) -> None:
    """Print a verdict with its reasons and the pictures to take next."""
    from uvgs_bench.cli.console import out

    words = {
        "usable": "USABLE",
        "usable_within_radius": f"USABLE WITHIN {verdict.radius_px:.0f} px of the principal point",
        "not_usable": "NOT USABLE",
        "inconclusive": "INCONCLUSIVE",
    }
    out.print(f"verdict      {words[verdict.word]}", style="bold green" if verdict.is_usable else "bold red")
    for reason in verdict.reasons:
        out.print(f"  because {reason}", markup=False)
    for wish in verdict.next_pictures:
        out.print(f"  next: {wish}", markup=False)
