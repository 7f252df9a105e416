"""What the calibration says about pictures it has not seen: two halves against each other, and folds."""

from __future__ import annotations

from typing import Any

import numpy as np

from uvgs_bench.camera.angular_scale import angle_per_pixel
from uvgs_bench.camera.cross_validation import SplitHalf
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.calibration_evidence import CalibrationEvidence
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Block, Column, Figure, Paragraph, Section, Table
from uvgs_bench.report.figures import series, style, svg_of
from uvgs_bench.report.maps import picture_canvas
from uvgs_bench.units import mrad_from_rad

_MOST_RATIO = 4.0


def build(evidence: CalibrationEvidence) -> Section | None:
    """Map of differences, map of ratios, folds."""
    result = evidence.result
    if result is None:
        return None
    blocks: list[Block] = []
    halves, lens = result.split_half, result.calibration.lens
    if halves is None:
        blocks.append(Paragraph(f"{len(result.views)} views are too few to calibrate two halves on their own."))
    else:
        text = (
            "The pictures are split at random into halves, each is calibrated on its own, and the two lenses are "
            "compared after the rotation that fits them best. Honest deviations give a ratio of 1; each half has only "
            "half of the pictures, so the difference itself is larger than the error of the whole."
        )
        mrad = mrad_from_rad(halves.grid_difference_px * angle_per_pixel(lens, halves.grid_px))
        blocks += [Paragraph(text), _figures(halves, mrad)]
        blocks += [
            _map(lens, halves, halves.grid_difference_px, "halves-px", "px", "Difference of two halves"),
            _map(lens, halves, mrad, "halves-mrad", "mrad", "Difference of two halves, as an angle"),
            _map(
                lens, halves, halves.grid_difference_px / np.maximum(halves.grid_predicted_px, 1e-12), "halves-ratio",
                "times", "Difference over its prediction",
            ),
        ]  # fmt: skip
    if result.fold_rms_px.size:
        blocks.append(_folds(result.fold_rms_px, result.calibration.held_out_rms_px))
    return Section("halves", "Pictures it has not seen", tuple(blocks))


def _figures(halves: SplitHalf, mrad: FloatArray) -> Table:
    rows: list[tuple[Cell, ...]] = [
        ("RMS difference over the covered picture", Number(halves.difference_px, 4, "px")),
        ("RMS difference, as an angle", Number(float(np.sqrt(np.nanmean(mrad**2))), 4, "mrad")),
        ("The same as predicted from the halves' own deviations", Number(halves.predicted_px, 4, "px")),
        ("Ratio, root mean square over the splits", Number(halves.ratio, 2, "times")),
        *((f"Ratio of split {i + 1}", Number(float(r), 2, "times")) for i, r in enumerate(halves.ratios)),
    ]
    return Table("Two halves in figures.", (Column("What"), Column("Value", is_numeric=True)), tuple(rows))


def _map(lens: Lens, halves: SplitHalf, values: FloatArray, key: str, unit: str, words: str) -> Figure:
    finite = values[np.isfinite(values)]
    low, middle, high = (float(v) for v in (finite.min(), np.median(finite), finite.max()))
    alt = (
        f"{words} at {len(values)} places of the covered picture: median {middle:.3g} {unit}, smallest {low:.3g}, "
        f"largest {high:.3g}."
    )
    top = _MOST_RATIO if unit == "times" else high
    step_u = lens.width_px / len(np.unique(halves.grid_px[:, 0]))
    with style(key):
        figure, axes = picture_canvas(lens.width_px, lens.height_px)
        options: dict[str, Any] = {"cmap": "cividis", "vmin": 0.0, "vmax": top, "marker": "s", "linewidths": 0.0}
        # Marks as large as fit between their neighbours, in points.
        side = min(72.0 * 3.3 * step_u / lens.width_px, 26.0)
        axes.scatter(halves.grid_px[:, 0], halves.grid_px[:, 1], s=side**2, c=values, **options)
        for (u, v), value in zip(halves.grid_px, values, strict=True):
            if np.isfinite(value):
                colour = "#ffffff" if value < 0.6 * top else "#000000"
                axes.text(
                    u, v, _short(float(value)), color=colour, fontsize=6.5, ha="center", va="center", in_layout=False
                )
        pad = 0.5 * step_u
        axes.set_xlim(-pad, lens.width_px - 1.0 + pad)
        axes.set_ylim(lens.height_px - 1.0 + pad, -pad)
        svg = svg_of(figure, key, alt)
    numbers = (
        series("column", "px", halves.grid_px[:, 0]),
        series("row", "px", halves.grid_px[:, 1]),
        series("value", unit, values),
    )
    return Figure(key, svg, alt, f"{words}, {unit}, all splits together.", numbers)


def _short(value: float) -> str:
    """Two significant digits in little room."""
    return f"{value:.2g}" if value < 10.0 else f"{value:.0f}"


def _folds(fold_rms_px: FloatArray, held_out_px: float | None) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (f"Fold {i + 1}", Number(float(rms), 4), Number(float(rms) / np.sqrt(2.0), 4))
        for i, rms in enumerate(fold_rms_px)
    ]
    whole = None if held_out_px is None else held_out_px / float(np.sqrt(2.0))
    rows.append(("All", Number(held_out_px, 4), Number(whole, 4)))
    columns = (Column("Pictures left out"), Column("RMS of lengths", "px", True), Column("RMS per axis", "px", True))
    caption = (
        "Each fold leaves every fifth picture (or fewer) out of the fit; its pose comes from half of its corners, its "
        "error from the other half."
    )
    return Table(caption, columns, tuple(rows))
