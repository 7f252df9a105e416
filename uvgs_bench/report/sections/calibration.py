"""The camera calibration the poses rest on."""

from __future__ import annotations

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.report.cells import Cell, Number, decimals_for
from uvgs_bench.report.document import Alert, Alerts, Block, Column, Section, Table
from uvgs_bench.store.run import Run


def build(run: Run, judgement: Judgement) -> Section | None:
    """Parameters with their doubt, residuals, provenance."""
    del judgement
    calibration = run.calibration
    lens, sigmas = calibration.lens, calibration.sigmas
    parameters: list[tuple[Cell, ...]] = []
    for k, name in enumerate(lens.parameter_names):
        unit = "px" if k < 4 else ""
        value = float(lens.parameters[k])
        sigma = None if sigmas is None else float(sigmas[k])
        decimals = decimals_for([sigma], default=3 if k < 4 else 6, most=9)
        parameters.append((name, Number(value, decimals, unit), Number(sigma, decimals, unit)))
    facts: list[tuple[Cell, ...]] = [
        ("Camera", calibration.camera_name or "not named"),
        ("Lens model", lens.model),
        ("Picture size", f"{lens.width_px} × {lens.height_px} px"),
        ("Reprojection RMS, both axes", Number(calibration.rms_px, 3, "px")),
        ("Reprojection RMS on held-out views", Number(calibration.held_out_rms_px, 3, "px")),
        ("Views", Number(calibration.view_count, 0)),
        ("Corners", Number(calibration.corner_count, 0)),
        ("Corners set aside", Number(calibration.rejected_count, 0)),
        *((name, text) for name, text in calibration.notes.items()),
    ]
    columns = (Column("Parameter"), Column("Value", is_numeric=True), Column("Standard deviation", is_numeric=True))
    blocks: list[Block] = [
        Table("Lens parameters.", columns, tuple(parameters)),
        Table("Quality and origin.", (Column("What"), Column("Value")), tuple(facts)),
    ]
    if sigmas is None:
        text = "This calibration carries no covariance: its doubt is not part of any interval in this report."
        blocks.append(Alerts((Alert("warning", text),)))
    return Section("calibration", "Camera calibration", tuple(blocks))
