"""``uvgs camera``: look at camera files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.options import Json

if TYPE_CHECKING:
    from uvgs_bench.camera import Calibration, Lens

app = typer.Typer(no_args_is_help=True, help="Look at camera files.")


@app.callback()
def camera() -> None:
    """Look at camera files."""


@app.command("show")
def show(
    path: Annotated[Path, typer.Argument(help="Camera file (camera_info YAML, with or without uvgs:).")],
    as_json: Json = False,
) -> None:
    """Show a lens: numbers, doubt, field of view, provenance."""
    from uvgs_bench.cli.console import emit_json
    from uvgs_bench.store.calibrations import read_calibration

    calibration = read_calibration(path)
    if as_json:
        emit_json(_summary(calibration))
        return
    _print(calibration)


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
