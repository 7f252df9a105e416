"""The lens: parameters with their doubt, how they hang together, and how other lenses did."""

from __future__ import annotations

import numpy as np

from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.fitting import CalibrationResult
from uvgs_bench.report.calibration_evidence import CalibrationEvidence
from uvgs_bench.report.cells import Cell, Number, decimals_for
from uvgs_bench.report.document import Alert, Alerts, Block, Column, Figure, Paragraph, Section, Table
from uvgs_bench.report.figures import canvas, series, style, svg_of
from uvgs_bench.units import mm_from_m

_TIED = 0.95
_PERCENT = 100.0


def build(evidence: CalibrationEvidence) -> Section | None:
    """Parameters, correlations, comparison of lenses, shape of the board."""
    calibration, result = evidence.calibration, evidence.result
    blocks: list[Block] = [_parameters(calibration, result)]
    if calibration.covariance is None:
        text = "The camera file carries no covariance: how sure these numbers are is unknown."
        blocks.append(Alerts((Alert("warning", text),)))
    else:
        blocks.append(_correlations(calibration))
    if result is not None:
        blocks.append(_models(result))
        if result.board_shape is not None:
            blocks.append(_board(result))
    return Section("lens", "Lens", tuple(blocks))


def _parameters(calibration: Calibration, result: CalibrationResult | None) -> Table:
    lens, sigmas = calibration.lens, calibration.sigmas
    others = result.all_corners.lens.parameters if result is not None and result.rejected else None
    rows: list[tuple[Cell, ...]] = []
    for k, name in enumerate(lens.parameter_names):
        unit = "px" if k < 4 else ""
        value = float(lens.parameters[k])
        sigma = None if sigmas is None else float(sigmas[k])
        decimals = decimals_for([sigma], default=3 if k < 4 else 6, most=9)
        relative = None if sigma is None or value == 0.0 else _PERCENT * sigma / abs(value)
        row: list[Cell] = [name, Number(value, decimals, unit), Number(sigma, decimals, unit), Number(relative, 2, "%")]
        if others is not None:
            row.append(Number(float(others[k]), decimals, unit))
        rows.append(tuple(row))
    columns = [Column("Parameter"), Column("Value", is_numeric=True), Column("1 sigma", is_numeric=True)]
    columns.append(Column("Relative", is_numeric=True))
    if others is not None:
        columns.append(Column("With every corner", is_numeric=True))
    caption = f"Parameters of the {lens.model} lens; all their digits are in the camera file."
    return Table(caption, tuple(columns), tuple(rows))


def _correlations(calibration: Calibration) -> Figure:
    assert calibration.covariance is not None
    assert calibration.sigmas is not None
    names = calibration.lens.parameter_names
    sigmas = np.maximum(calibration.sigmas, 1e-300)
    rho = calibration.covariance / np.outer(sigmas, sigmas)
    upper = [(abs(rho[i, j]), i, j) for i in range(len(names)) for j in range(i + 1, len(names))]
    strongest, i, j = max(upper)
    tied = sum(value > _TIED for value, _, _ in upper)
    key = "correlation"
    alt = (
        f"Correlation of {len(names)} parameters: strongest {names[i]} with {names[j]} {rho[i, j]:+.3f} "
        f"(absolute {strongest:.3f}); {tied} pairs beyond {_TIED}."
    )
    with style(key):
        figure = canvas(4.0)
        axes = figure.add_subplot()
        axes.pcolormesh(np.abs(rho), cmap="cividis", vmin=0.0, vmax=1.0)
        size = 7.0 if len(names) <= 9 else 5.0
        for (r, c), value in np.ndenumerate(rho):
            colour = "#ffffff" if abs(value) < 0.6 else "#000000"
            axes.text(
                c + 0.5, r + 0.5, f"{value:.2f}", ha="center", va="center", in_layout=False, fontsize=size, color=colour
            )
        ticks = np.arange(len(names)) + 0.5
        axes.set_xticks(ticks, names)
        axes.set_yticks(ticks, names)
        axes.tick_params(length=0)
        axes.invert_yaxis()
        axes.set_aspect("equal")
        axes.grid(False)
        svg = svg_of(figure, key, alt)
    caption = "Correlation of the parameters. Tied ones mean something together only: judge by the maps."
    return Figure(key, svg, alt, caption, tuple(series(name, "1", row) for name, row in zip(names, rho, strict=True)))


def _models(result: CalibrationResult) -> Block:
    if not result.lens_trials:
        text = f"Only the {result.calibration.lens.model} lens was fitted; --model auto compares all."
        return Paragraph(text)
    rows: list[tuple[Cell, ...]] = []
    for trial in result.lens_trials:
        is_chosen = trial.model == result.calibration.lens.model
        said = "chosen: the fewest coefficients not clearly worse" if is_chosen else trial.remark or "no better"
        rows.append((trial.model, Number(trial.rms_px, 4), Number(trial.held_out_rms_px, 4), said))
    columns = (
        Column("Lens"), Column("RMS of lengths", "px", True), Column("Unseen pictures", "px", True), Column("Remark"),
    )  # fmt: skip
    return Table("Lenses compared on the same corners, none set aside.", columns, tuple(rows))


def _board(result: CalibrationResult) -> Table:
    assert result.board_shape is not None
    (bow_x, bow_y, stretch), (bow_x_sigma, bow_y_sigma, stretch_sigma) = result.board_shape
    rows: list[tuple[Cell, ...]] = [
        (f"Bow along {axis}", Number(float(mm_from_m(bow)), 3, "mm"), Number(float(mm_from_m(sigma)), 3, "mm"))
        for axis, bow, sigma in (("x", bow_x, bow_x_sigma), ("y", bow_y, bow_y_sigma))
    ]
    percent = (Number(_PERCENT * float(stretch), 4, "%"), Number(_PERCENT * float(stretch_sigma), 4, "%"))
    rows.append(("y printed longer than x", *percent))
    columns = (Column("Shape of the board"), Column("Value", is_numeric=True), Column("1 sigma", is_numeric=True))
    return Table("The printed board as the pictures tell it.", columns, tuple(rows))
