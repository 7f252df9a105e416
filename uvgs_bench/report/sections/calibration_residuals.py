"""What the lens leaves unexplained: as a field over the picture, against the normal law, by radius."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from uvgs_bench.camera.fitting import CalibrationResult
from uvgs_bench.camera.residual_structure import GRID_COLUMNS, GRID_ROWS, cell_centres_px
from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.calibration_evidence import CalibrationEvidence, kept_masks
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Column, Figure, Paragraph, Section, Table
from uvgs_bench.report.figures import canvas, legend_above, series, style, svg_of, thinned
from uvgs_bench.report.maps import picture_canvas
from uvgs_bench.report.palette import BLUE, FAINT, INK, ORANGE, SERIES
from uvgs_bench.units import mrad_from_rad

_SHOWN_SIGMAS = 5.0
_FEWEST_IN_CELL = 4
# Means of noise are short; what is left of them must be seen.
_MEAN_BOOST = 5.0


def build(evidence: CalibrationEvidence) -> Section | None:
    """Figures, field, histogram, rings."""
    result = evidence.result
    if result is None:
        return None
    masks = kept_masks(result)
    px = np.concatenate([view.px[mask] for view, mask in zip(result.views, masks, strict=True)])
    e = np.concatenate([part[mask] for part, mask in zip(result.residuals_px, masks, strict=True)])
    noise = np.repeat(result.view_noise_px, [int(mask.sum()) for mask in masks])
    text = (
        "Residual = observed − projected, of the kept corners. What is left by a right lens looks like noise: no "
        "pattern over the picture, no bulge away from the normal law, neighbours independent."
    )
    blocks = (Paragraph(text), _figures(result), _field(result, px, e), _histogram(result, e, noise), _rings(result))
    return Section("residuals", "Residuals", blocks)


def _figures(result: CalibrationResult) -> Table:
    calibration, everything, structure = result.calibration, result.all_corners, result.structure
    lengths_mrad = float(mrad_from_rad(structure.rms_rad))
    rows: list[tuple[Cell, ...]] = [
        ("RMS of residual lengths", Number(calibration.rms_px, 4, "px")),
        ("RMS per axis", Number(calibration.rms_per_axis_px, 4, "px")),
        ("RMS of residual lengths, as an angle", Number(lengths_mrad, 4, "mrad")),
        ("RMS per axis, as an angle", Number(lengths_mrad / math.sqrt(2.0), 4, "mrad")),
        ("RMS of residual lengths before any corner was set aside", Number(everything.rms_px, 4, "px")),
        ("Held-out RMS of residual lengths", Number(calibration.held_out_rms_px, 4, "px")),
        ("Correlation of neighbouring residuals", Number(structure.neighbour_correlation, 2)),
        ("Part of the RMS that neighbours share", Number(structure.systematic_px, 4, "px")),
        ("Kurtosis of the components (normal law: 3)", Number(structure.kurtosis, 2)),
    ]
    return Table("Residuals in figures.", (Column("What"), Column("Value", is_numeric=True)), tuple(rows))


def _field(result: CalibrationResult, px: FloatArray, e: FloatArray) -> Figure:
    lens = result.calibration.lens
    column = np.clip((px[:, 0] + 0.5) * GRID_COLUMNS / lens.width_px, 0, GRID_COLUMNS - 1).astype(int)
    row = np.clip((px[:, 1] + 0.5) * GRID_ROWS / lens.height_px, 0, GRID_ROWS - 1).astype(int)
    cell = row * GRID_COLUMNS + column
    size = GRID_COLUMNS * GRID_ROWS
    count = np.bincount(cell, minlength=size)
    mean = np.stack([np.bincount(cell, e[:, k], size) for k in (0, 1)], axis=1) / np.maximum(count, 1)[:, None]
    enough = count >= _FEWEST_IN_CELL
    length = np.linalg.norm(mean[enough], axis=1)
    typical = float(np.median(np.linalg.norm(e, axis=1)))
    magnification = _round_down(0.045 * lens.width_px / max(typical, 1e-9))
    centres = cell_centres_px(lens)
    key = "residual-field"
    longest = f"{length.max():.3g} px" if len(length) else "none"
    alt = (
        f"Residuals of {len(e)} corners over the picture, {magnification:g} times as long as true: median length "
        f"{typical:.3g} px; mean of a cell of at least {_FEWEST_IN_CELL} corners: longest {longest}."
    )
    with style(key):
        figure, axes = picture_canvas(lens.width_px, lens.height_px)
        shown = thinned(len(e))
        ends = np.stack([px[shown], px[shown] + magnification * e[shown]], axis=1)
        # One line with gaps draws a thousand vectors as fast as one.
        gaps = np.concatenate([ends, np.full((len(ends), 1, 2), np.nan)], axis=1).reshape(-1, 2)
        axes.plot(*gaps.T, "-", color=BLUE, lw=0.6, alpha=0.75, label=f"residual × {magnification:g}")
        place, arrow = centres[enough], _MEAN_BOOST * magnification * mean[enough]
        options: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.007, "zorder": 3}
        label = f"mean of a cell × {_MEAN_BOOST * magnification:g}"
        axes.quiver(place[:, 0], place[:, 1], arrow[:, 0], arrow[:, 1], color=ORANGE, label=label, **options)
        legend_above(axes, 2)
        svg = svg_of(figure, key, alt)
    caption = f"Residuals, {magnification:g} times as long as true. Arrows that agree show what the lens cannot do."
    numbers = tuple(
        series(name, "px", values)
        for name, values in (
            ("column", px[:, 0]), ("row", px[:, 1]), ("residual right", e[:, 0]), ("residual down", e[:, 1]),
        )
    )  # fmt: skip
    return Figure(key, svg, alt, caption, numbers)


def _histogram(result: CalibrationResult, e: FloatArray, noise_px: FloatArray) -> Figure:
    z = e / noise_px[:, None]
    spread = z.std(axis=0)
    beyond = float((np.abs(z) > 3.0).mean())
    key = "residual-histogram"
    alt = (
        f"{z.size} residual components over the noise of their picture against the standard normal law: standard "
        f"deviation {spread[0]:.2f} right, {spread[1]:.2f} down; {100 * beyond:.2f} % beyond 3 (0.27 % expected); "
        f"kurtosis {result.structure.kurtosis:.1f} (3 expected)."
    )
    with style(key):
        figure = canvas(3.6)
        axes = figure.add_subplot()
        edges = np.linspace(-_SHOWN_SIGMAS, _SHOWN_SIGMAS, 41)
        for k, name in enumerate(("right", "down")):
            bars: dict[str, Any] = {"bins": edges, "density": True, "histtype": "step", "lw": 1.5}
            axes.hist(np.clip(z[:, k], edges[0] + 1e-9, edges[-1] - 1e-9), color=SERIES[k], label=name, **bars)
        grid = np.linspace(-_SHOWN_SIGMAS, _SHOWN_SIGMAS, 201)
        axes.plot(grid, np.exp(-0.5 * grid**2) / np.sqrt(2.0 * np.pi), "--", color=INK, lw=1.2, label="normal law")
        axes.set_xlabel("residual / noise of its picture (outermost bars: and beyond)")
        axes.set_ylabel("density")
        legend_above(axes, 3)
        svg = svg_of(figure, key, alt)
    caption = "Residual components over the standard deviation of their picture; dashed: the law the deviations assume."
    return Figure(key, svg, alt, caption, (series("right", "1", z[:, 0]), series("down", "1", z[:, 1])))


def _rings(result: CalibrationResult) -> Figure:
    s = result.structure
    key = "residual-rings"
    worst = int(np.argmax(np.abs(s.ring_outward_px)))
    alt = (
        f"Residuals by distance from the principal point in {len(s.ring_rms_px)} rings of equally many corners: RMS "
        f"{s.ring_rms_px.min():.3g} to {s.ring_rms_px.max():.3g} px; largest mean outward residual "
        f"{s.ring_outward_px[worst]:+.3g} px at {s.ring_radius_px[worst]:.0f} px."
    )
    with style(key):
        figure = canvas(3.6)
        axes = figure.add_subplot()
        axes.axhline(0.0, color=FAINT, lw=0.8)
        axes.plot(s.ring_radius_px, s.ring_rms_px, "o-", color=SERIES[0], ms=4.5, label="RMS of lengths")
        axes.plot(s.ring_radius_px, s.ring_outward_px, "^-", color=SERIES[1], ms=4.5, label="mean, outward")
        axes.set_xlim(left=0.0)
        axes.set_xlabel("distance from the principal point (px)")
        axes.set_ylabel("residual (px)")
        legend_above(axes, 2)
        svg = svg_of(figure, key, alt)
    caption = "Residuals by radius. A mean away from zero is a bend the lens model cannot follow."
    numbers = (
        series("radius", "px", s.ring_radius_px),
        series("RMS", "px", s.ring_rms_px),
        series("mean outward", "px", s.ring_outward_px),
    )
    return Figure(key, svg, alt, caption, numbers)


def _round_down(value: float) -> float:
    """1, 2 or 5 times a power of ten, so that readers can divide in their heads."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1.0 + 1e-12))
