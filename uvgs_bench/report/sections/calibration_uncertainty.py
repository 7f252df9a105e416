"""How sure the calibration is of where a point is seen, over the picture: in px, and in mm at a distance."""

from __future__ import annotations

import numpy as np

from uvgs_bench.camera.angular_scale import angle_per_pixel
from uvgs_bench.camera.calibration import Calibration
from uvgs_bench.camera.projection_uncertainty import lateral_uncertainty, projection_uncertainty, worst_sigma
from uvgs_bench.camera.verdict import LIMIT_PX, total_error_px
from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.calibration_evidence import CalibrationEvidence
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Column, Figure, Paragraph, Section, Table
from uvgs_bench.report.figures import series, style, svg_of
from uvgs_bench.report.maps import draw_circles, draw_map, map_grid, picture_canvas
from uvgs_bench.units import mm_from_m, mrad_from_rad

_DISTANCE_M = 2.0
_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)


def build(evidence: CalibrationEvidence) -> Section | None:
    """Maps of px and mm, the total error the verdict looks at, and figures by radius."""
    calibration, result = evidence.calibration, evidence.result
    if calibration.joint_covariance is None:
        return None
    px = map_grid(calibration.lens).reshape(-1, 2)
    sigma_px = worst_sigma(projection_uncertainty(calibration, px))
    lateral_mm = mm_from_m(worst_sigma(lateral_uncertainty(calibration, px, _DISTANCE_M)))
    text = (
        "One standard deviation along the worst direction, from the pictures' own noise. The boards move along when "
        "the lens changes: what both share is no error. It is a bias of this calibration, the same in every picture."
    )
    figures = [
        _map(evidence, "uncertainty-px", sigma_px, "px", "Where a far point is seen, 1 sigma"),
        _map(evidence, "uncertainty-mm", lateral_mm, "mm", f"Across the line of sight at {_DISTANCE_M:g} m, 1 sigma"),
    ]
    if result is not None:
        total = total_error_px(result, px)
        words = f"Total error of the verdict (limit {LIMIT_PX} px)"
        figures.append(_map(evidence, "uncertainty-total", total, "px", words))
    return Section("uncertainty", "Projection uncertainty", (Paragraph(text), _table(calibration), *figures))


def _table(calibration: Calibration) -> Table:
    """Right of the principal point towards the picture's farther edge."""
    lens = calibration.lens
    edge = lens.width_px - 1.0 if lens.cx_px < 0.5 * lens.width_px else 0.0
    px = np.array([[lens.cx_px + share * (edge - lens.cx_px), lens.cy_px] for share in _SHARES])
    sigma_px = worst_sigma(projection_uncertainty(calibration, px))
    sigma_m = worst_sigma(lateral_uncertainty(calibration, px, _DISTANCE_M))
    angle = mrad_from_rad(sigma_px * angle_per_pixel(lens, px))
    rows: list[tuple[Cell, ...]] = [
        (
            f"({u:.0f}, {v:.0f})",
            Number(abs(u - lens.cx_px), 0),
            Number(float(sigma_px[i]), 4),
            Number(float(angle[i]), 4),
            Number(float(mm_from_m(sigma_m[i])), 4),
        )
        for i, (u, v) in enumerate(px)
    ]
    columns = (
        Column("Pixel (column, row)"),
        Column("From the principal point", "px", True),
        Column("1 sigma", "px", True),
        Column("1 sigma", "mrad", True),
        Column(f"1 sigma at {_DISTANCE_M:g} m", "mm", True),
    )
    return Table("From the principal point to the farther side of the picture.", columns, tuple(rows))


def _map(evidence: CalibrationEvidence, key: str, values: FloatArray, unit: str, words: str) -> Figure:
    calibration, result = evidence.calibration, evidence.result
    lens, verdict = calibration.lens, calibration.verdict
    grid_px = map_grid(lens)
    px = grid_px.reshape(-1, 2)
    radius = np.linalg.norm(px - lens.parameters[2:4], axis=1)
    usable_px = 0.0 if verdict is None else verdict.radius_px
    centre = float(values[int(np.argmin(radius))])
    blind = int(np.isnan(values).sum())
    alt = f"{words}: {centre:.3g} {unit} at the principal point, {np.nanmax(values):.3g} {unit} at worst"
    if usable_px > 0.0:
        alt += f", {np.nanmax(values[radius <= usable_px]):.3g} {unit} at worst within the usable {usable_px:.0f} px"
    alt += f"; no ray in {100 * blind / len(values):.0f} % of the picture." if blind else "."
    with style(key):
        figure, axes = picture_canvas(lens.width_px, lens.height_px)
        draw_map(figure, axes, grid_px, values.reshape(grid_px.shape[:2]), unit)
        covered_px = 0.0 if result is None else result.coverage.radius_px
        draw_circles(axes, lens, covered_px, usable_px)
        svg = svg_of(figure, key, alt)
    numbers = (series("column", "px", px[:, 0]), series("row", "px", px[:, 1]), series("value", unit, values))
    return Figure(key, svg, alt, f"{words}, {unit}.", numbers)
