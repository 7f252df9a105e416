"""``uvgs calibrate``: from pictures of a board to a camera file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.options import Force, Json, Quiet
from uvgs_bench.errors import ConfigError

if TYPE_CHECKING:
    from uvgs_bench.camera import CalibrationResult


def calibrate(
    source: Annotated[str, typer.Argument(help="Pictures of the board: images:DIR, video:FILE or uvc:0.")],
    board: Annotated[Path, typer.Option("--board", help="Board file.")],
    out: Annotated[Path, typer.Option("--out", help="Camera file to write (camera_info YAML).")],
    model: Annotated[
        str, typer.Option("--model", help="plumb_bob, rational_polynomial, thin_prism, equidistant or fov.")
    ] = "plumb_bob",
    name: Annotated[str, typer.Option("--name", help="Camera name; the file's own name by default.")] = "",
    glob: Annotated[str, typer.Option("--glob", help="Only pictures of this pattern, for example 'left*.jpg'.")] = "",
    no_reject: Annotated[bool, typer.Option("--no-reject", help="Keep every corner, outliers too.")] = False,
    limit: Annotated[int | None, typer.Option("--limit", min=1, help="Take at most so many captures.")] = None,
    force: Force = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Calibrate a camera from pictures of a board."""
    from uvgs_bench.camera import LENSES
    from uvgs_bench.cli.console import emit_json, print_path, progress_sink
    from uvgs_bench.devices.cameras.registry import open_camera
    from uvgs_bench.sessions.calibrate import calibrate_from_source
    from uvgs_bench.store.boards import read_board
    from uvgs_bench.store.calibrations import write_calibration
    from uvgs_bench.store.documents import check_writable

    check_writable(out, force=force)
    if model not in LENSES:
        raise ConfigError(f"unknown lens model '{model}', expected one of {', '.join(LENSES)}", "--model")
    if glob:
        source += ("&" if "?" in source else "?") + f"glob={glob}"
    declared = read_board(board)
    with open_camera(source) as camera, progress_sink(quiet=quiet) as sink:
        result = calibrate_from_source(
            camera,
            declared,
            model,
            sink=sink,
            camera_name=name or out.stem,
            reject_outliers=not no_reject,
            limit=limit,
        )
    if not as_json:
        # Before writing, so that a full disk takes the file but not the numbers.
        _show(result)
    write_calibration(out, result.calibration, force=force)
    if as_json:
        emit_json(_summary(result, out))
        return
    print_path("written", out)


def _summary(result: CalibrationResult, out: Path) -> dict[str, object]:
    fitted, everything = result.calibration, result.all_corners
    assert fitted.sigmas is not None
    names = fitted.lens.parameter_names
    return {
        "camera": str(out),
        "model": fitted.lens.model,
        "width_px": fitted.lens.width_px,
        "height_px": fitted.lens.height_px,
        "parameters": dict(zip(names, fitted.lens.parameters.tolist(), strict=True)),
        "sigmas": dict(zip(names, fitted.sigmas.tolist(), strict=True)),
        "rms_px": fitted.rms_px,
        "rms_per_axis_px": fitted.rms_per_axis_px,
        "held_out_rms_px": fitted.held_out_rms_px,
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


def _show(result: CalibrationResult) -> None:
    from collections import Counter

    from rich.markup import escape
    from rich.table import Table

    from uvgs_bench.cli.console import out

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
    per_axis = f"{fitted.rms_per_axis_px:.4f} px per axis"
    out.print(f"RMS          {fitted.rms_px:.4f} px (of residual lengths) = {per_axis}")
    if result.rejected:
        out.print(f"  all corners {everything.rms_px:.4f} px before outliers were set aside", style="dim")
    held_out = "too few views" if fitted.held_out_rms_px is None else f"{fitted.held_out_rms_px:.4f} px"
    out.print(f"held out     {held_out}")
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
