"""What ``uvgs camera diff`` and ``uvgs camera check`` print."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from uvgs_bench.camera.difference import LensDifference
    from uvgs_bench.camera.validity import Validity

_TABLE_ROWS, _TABLE_COLUMNS = 7, 9
_WORDS = {
    "ok": "[bold green]OK[/]",
    "degraded": "[bold red]DEGRADED[/]",
    "inconclusive": "[bold yellow]INCONCLUSIVE[/]",
}


def difference_summary(found: LensDifference) -> dict[str, object]:
    """The difference as one JSON object."""
    from uvgs_bench.geometry.se3 import rotation_angle
    from uvgs_bench.units import deg_from_rad

    return {
        "rms_px": found.rms_px,
        "max_px": found.max_px,
        "max_at_px": found.max_at_px,
        "centre_px": found.centre_px,
        "predicted_rms_px": found.predicted_rms_px,
        "rotation_deg": float(deg_from_rad(rotation_angle(found.R_ba))),
        "compared_share": found.compared_share,
        "grid_px": found.grid_px,
        "shift_px": found.shift_px,
        "sigma_px": found.sigma_px,
    }


def print_difference(found: LensDifference) -> None:
    """Figures, and the map as a table."""
    from rich.table import Table

    from uvgs_bench.cli.console import out
    from uvgs_bench.geometry.se3 import rotation_angle
    from uvgs_bench.units import deg_from_rad

    length = np.linalg.norm(found.shift_px, axis=2)
    rows = np.linspace(0, length.shape[0] - 1, _TABLE_ROWS).round().astype(int)
    columns = np.linspace(0, length.shape[1] - 1, _TABLE_COLUMNS).round().astype(int)
    table = Table(box=None, pad_edge=False, title="shift, px, by row and column", title_justify="left")
    table.add_column("", justify="right", style="dim")
    for column in columns:
        table.add_column(f"{found.grid_px[0, column, 0]:.0f}", justify="right", header_style="dim")
    for row in rows:
        cells = ["-" if not np.isfinite(length[row, c]) else f"{length[row, c]:.3f}" for c in columns]
        table.add_row(f"{found.grid_px[row, 0, 1]:.0f}", *cells)
    out.print(table)
    u, v = found.max_at_px
    out.print(f"worst       {found.max_px:.4f} px at ({u:.0f}, {v:.0f})")
    out.print(f"centre      {found.centre_px:.4f} px")
    out.print(f"RMS         {found.rms_px:.4f} px over {100.0 * found.compared_share:.1f} % of the picture")
    if found.predicted_rms_px is None:
        out.print("expected    unknown: a file without covariance")
    else:
        ratio = found.rms_px / max(found.predicted_rms_px, 1e-12)
        out.print(f"expected    {found.predicted_rms_px:.4f} px from both covariances: {ratio:.2f} times that")
    out.print(f"rotation    {float(deg_from_rad(rotation_angle(found.R_ba))):.4f} deg taken out")


def validity_summary(found: Validity) -> dict[str, object]:
    """The verdict as one JSON object."""
    return {
        "verdict": found.verdict,
        "figures": [
            {
                "name": figure.name,
                "value": figure.value,
                "low": figure.low,
                "high": figure.high,
                "limit": figure.limit,
                "unit": figure.unit.strip(),
                "verdict": figure.verdict,
            }
            for figure in found.figures
        ],
        "held_out_rms_px": found.held_out_rms_px,
        "file_rms_px": found.file_rms_px,
        "views": dict(zip(found.view_names, found.view_rms_px.tolist(), strict=True)),
        "corner_count": found.corner_count,
        "rejected_count": found.rejected_count,
        "moved_centre_px": found.moved.centre_px,
        "moved_max_px": found.moved.max_px,
        "reasons": list(found.reasons),
    }


def print_validity(found: Validity) -> None:
    """Verdict, figures, reasons."""
    from rich.markup import escape
    from rich.table import Table

    from uvgs_bench.cli.console import out

    table = Table(box=None, pad_edge=False)
    for name in ("quantity", "new views against file", "95 % interval", "limit", ""):
        table.add_column(name, justify="left" if name in ("quantity", "") else "right")
    for figure in found.figures:
        table.add_row(
            figure.name,
            f"{figure.value:.3f}{figure.unit}",
            f"{figure.low:.3f} to {figure.high:.3f}{figure.unit}",
            f"{figure.limit:g}{figure.unit}",
            _WORDS[figure.verdict],
        )
    out.print(table)
    known = "unknown" if found.file_rms_px is None else f"{found.file_rms_px:.4f} px"
    out.print(f"held out    {found.held_out_rms_px:.4f} px on {len(found.view_names)} new views; the file says {known}")
    out.print(
        f"with focal lengths and centre of the new views, pixels move by {found.moved.max_px:.3f} px at most, "
        f"{found.moved.centre_px:.3f} px at the centre (after the rotation)"
    )
    for reason in found.reasons:
        out.print(f"  {escape(reason)}", soft_wrap=True)
    out.print(f"verdict     {_WORDS[found.verdict]}")
