"""Picture by picture: residuals, noise, the worst ones to look at, what was set aside, where no board was found."""

from __future__ import annotations

import numpy as np

from uvgs_bench.camera.fitting import CalibrationResult
from uvgs_bench.report.calibration_evidence import CalibrationEvidence, kept_masks, worst_views
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Block, Column, Figure, Gallery, Paragraph, Picture, Section, Table
from uvgs_bench.report.figures import canvas, series, style, svg_of
from uvgs_bench.report.palette import BLUE, FAINT
from uvgs_bench.report.pictures import residual_png, shown_picture
from uvgs_bench.units import deg_from_rad

PICTURED = 6
_LISTED = 60
_PERCENT = 100.0
# Normal law: two-sided 95 %.
_NORMAL_95 = 1.96


def build(evidence: CalibrationEvidence) -> Section | None:
    """Table of views, pictures of the worst, rejected corners, misses."""
    result = evidence.result
    if result is None:
        return None
    blocks: list[Block] = [_views(result)]
    magnification = _magnification(result)
    pictures = tuple(
        _picture(evidence, result, i, magnification)
        for i in worst_views(result, PICTURED)
        if result.view_names[i] in evidence.pictures
    )
    if pictures:
        text = (
            f"The pictures with the largest residuals. Lines: residuals of the kept corners, {magnification:g} times "
            "as long as true. Crosses: corners set aside."
        )
        blocks += [Paragraph(text), Gallery(pictures)]
    else:
        blocks.append(Paragraph("The pictures themselves were not at hand when this report was made."))
    blocks.append(_rejected(result))
    blocks += _drift(result)
    if result.misses:
        columns = (Column("Picture"), Column("Reason"), Column("In words"))
        rows = tuple((miss.name, miss.reason.replace("_", " "), miss.detail) for miss in result.misses)
        blocks.append(Table("Pictures without a usable board.", columns, rows))
    return Section("views", "Picture by picture", tuple(blocks))


def _views(result: CalibrationResult) -> Table:
    masks = kept_masks(result)
    tilts = deg_from_rad(result.coverage.tilts_rad)
    rows: list[tuple[Cell, ...]] = []
    for i in worst_views(result, len(result.views)):
        held_out = float(result.view_held_out_px[i]) if result.view_held_out_px.size else None
        rows.append(
            (
                result.view_names[i],
                Number(int(masks[i].sum()), 0),
                Number(int((~masks[i]).sum()), 0),
                Number(float(result.view_rms_px[i]), 3),
                Number(float(result.view_noise_px[i]), 3),
                Number(held_out, 3),
                Number(float(tilts[i]), 1),
                Number(float(result.coverage.distances_m[i]), 3),
            )
        )
    columns = (
        Column("Picture"),
        Column("Corners", is_numeric=True),
        Column("Set aside", is_numeric=True),
        Column("RMS of lengths", "px", True),
        Column("Noise per axis", "px", True),
        Column("Held out", "px", True),
        Column("Tilt", "deg", True),
        Column("Distance", "m", True),
    )
    caption = "All pictures used, the largest residuals first. Noise: with the degrees of freedom counted."
    return Table(caption, columns, tuple(rows))


def _magnification(result: CalibrationResult) -> float:
    """The same for all pictures, so that they can be compared: typical residuals a fortieth of the picture."""
    lengths = np.concatenate([np.linalg.norm(part, axis=1) for part in result.residuals_px])
    typical = max(float(np.nanmedian(lengths)), 1e-6)
    return float(f"{0.025 * result.calibration.lens.width_px / typical:.1g}")


def _picture(evidence: CalibrationEvidence, result: CalibrationResult, i: int, magnification: float) -> Picture:
    view, name, mask = result.views[i], result.view_names[i], kept_masks(result)[i]
    e = result.residuals_px[i]
    worst = int(np.nanargmax(np.linalg.norm(np.where(mask[:, None], e, 0.0), axis=1)))
    u, v = view.px[worst]
    alt = (
        f"Picture {name} with the residuals of {int(mask.sum())} corners: RMS {result.view_rms_px[i]:.3f} px, largest "
        f"kept {np.linalg.norm(e[worst]):.2f} px at column {u:.0f}, row {v:.0f}; {int((~mask).sum())} set aside."
    )
    png = residual_png(shown_picture(evidence.pictures[name]), view.px, e, mask, magnification)
    caption = f"{name}: RMS {result.view_rms_px[i]:.3f} px, set aside: {int((~mask).sum())}."
    return Picture(f"view-{i}", png, alt, caption)


def _drift(result: CalibrationResult) -> list[Block]:
    """The focal length picture by picture, and pictures taken in motion."""
    trends = result.trends
    if trends is None or not np.isfinite(trends.drift):
        return []
    change, sigma = _PERCENT * trends.focal_change, _PERCENT * trends.focal_sigma
    known = np.isfinite(change) & np.isfinite(sigma)
    number = np.flatnonzero(known) + 1.0
    key = "focal-order"
    moved = ", ".join(result.view_names[streak.view] for streak in trends.streaks) or "none"
    alt = (
        f"Focal length of {int(known.sum())} pictures in their order, relative to the common one: line from first to "
        f"last {_PERCENT * trends.drift:+.3f} ± {_PERCENT * trends.drift_sigma:.3f} %. Pictures that look taken in "
        f"motion: {moved}."
    )
    with style(key):
        figure = canvas(3.0)
        axes = figure.add_subplot()
        axes.axhline(0.0, color=FAINT, lw=1.0)
        axes.errorbar(number, change[known], yerr=_NORMAL_95 * sigma[known], fmt="o", color=BLUE, ms=4, capsize=2)
        axes.set_xlabel("picture, in the order taken")
        axes.set_ylabel("focal length, change (%)")
        svg = svg_of(figure, key, alt)
    caption = "Focal length each picture alone would like, against the common one, 95 %. A slope is a focus that moved."
    numbers = (series("change", "%", change), series("1 sigma", "%", sigma))
    blocks: list[Block] = [Figure(key, svg, alt, caption, numbers)]
    if trends.streaks:
        rows = tuple(
            (
                result.view_names[streak.view],
                Number(streak.ratio, 1),
                Number(float(deg_from_rad(streak.direction_rad)), 0),
            )
            for streak in trends.streaks
        )
        columns = (Column("Picture"), Column("Along over across", "times", True), Column("Direction", "deg", True))
        blocks.append(Table("Pictures whose residuals lie along one direction: taken in motion.", columns, rows))
    return blocks


def _rejected(result: CalibrationResult) -> Block:
    if not result.rejected:
        return Paragraph("No corner was set aside.")
    rows: list[tuple[Cell, ...]] = [
        (c.view, Number(c.index, 0), Number(c.u_px, 1), Number(c.v_px, 1), Number(c.residual_px, 2))
        for c in result.rejected[:_LISTED]
    ]
    columns = (
        Column("Picture"),
        Column("Corner", is_numeric=True),
        Column("Column", "px", True),
        Column("Row", "px", True),
        Column("Off by", "px", True),
    )
    more = len(result.rejected) - len(rows)
    tail = f" The worst {_LISTED} of {len(result.rejected)} are listed." if more else ""
    caption = (
        f"Corners set aside beyond four standard deviations, at most a tenth of all: {len(result.rejected)}.{tail}"
    )
    return Table(caption, columns, tuple(rows))
